"""The experiment: from raw trials, of the real testbed or of its twin, to the paper's data sets."""
