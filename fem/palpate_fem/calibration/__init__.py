"""Parameters of a fingertip from measured forces."""
