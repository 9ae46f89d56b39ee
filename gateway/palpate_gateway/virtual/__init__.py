"""A virtual BioTac with ground truth: from a tape of simulated indentations, or by a formula."""
