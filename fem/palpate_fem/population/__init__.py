"""Several BioTacs on one simulated finger: answers of their electrodes, fitted to ranges."""
