"""Many trajectories of one fingertip at once, on a GPU."""
