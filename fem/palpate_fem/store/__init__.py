"""Simulations on disk: whole files, crash-safe, resumable."""
