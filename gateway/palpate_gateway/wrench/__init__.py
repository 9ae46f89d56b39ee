"""Force/torque sensors: where they sit, and a driver for each protocol."""
