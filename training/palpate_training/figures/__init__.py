"""Figures as in the paper, and the statistics page of a data set of the experiment."""
