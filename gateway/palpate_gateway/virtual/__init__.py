"""A finger in software."""
