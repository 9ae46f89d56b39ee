"""The gateway: devices in, stamped and tared frames out."""
