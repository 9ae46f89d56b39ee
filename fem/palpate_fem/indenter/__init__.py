"""Rigid indenters as exact distances, and the paths they take."""
