"""Poses of the indenter from a user's robot: how its frames hang together, live and from files."""
