"""Benchmarks: palpate beside the bare floor, measured in one run."""
