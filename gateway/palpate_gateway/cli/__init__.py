"""Commands of the gateway: what is there, whether it answers, and devices in software."""
