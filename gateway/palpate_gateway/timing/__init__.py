"""The device's time, the host's time, and what a frame says of both."""
