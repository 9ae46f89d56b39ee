"""Bytes on the wire as pure functions: no ports, no clocks, no threads."""
