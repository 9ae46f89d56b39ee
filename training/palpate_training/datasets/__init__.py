"""Data sets: rows of features, the experiment of the paper, how they are made, read and written."""
