"""Poses of the indenter from a robot, live and from files."""
