"""Estimates from model bundles, records of everything on the bus, and views of both."""
