"""BioTacs: slots to frames, and the lines that bring the slots."""
