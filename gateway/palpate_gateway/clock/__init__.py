"""The device's clock and the host's: when each reading was sampled."""
