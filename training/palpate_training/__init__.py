"""Recordings and simulations -> data sets -> networks -> bundles; the only room with torch."""
