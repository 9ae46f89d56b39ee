"""Benchmarks: palpate beside the bare floor, measured in one run.

Each raises ``ProcessEnded`` if a process of it ends early, and ``LinkError`` if its processes do
not find one another, or no message comes, in time.
"""
