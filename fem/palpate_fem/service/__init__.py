"""Simulations on request: the service on the bus, its worker processes, and batches over them."""
