"""Workers that solve, and the service that asks them."""
