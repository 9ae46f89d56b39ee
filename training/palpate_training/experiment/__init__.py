"""The experiment of the paper: where the robot stands, what it executes, what is recorded."""
