"""Force/torque sensors: the base of all, and a driver for each protocol."""
