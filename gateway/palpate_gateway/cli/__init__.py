"""Commands of the gateway: list, probe and monitor devices, and emulate them."""
