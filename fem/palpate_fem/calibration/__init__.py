"""Mechanical parameters of a fingertip from measured forces."""
