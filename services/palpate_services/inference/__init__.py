"""A bundle on disk to estimates on the bus."""
