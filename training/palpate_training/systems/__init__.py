"""Systems that estimate from electrodes: the paper's, those that it cites, and ours."""
