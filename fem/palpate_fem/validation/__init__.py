"""Simulated against measured forces, compared as in the paper."""
