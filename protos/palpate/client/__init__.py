"""The client of a robot: current estimates, simulations, tare, presence, its own pose."""

from palpate.client.robot import Client

__all__ = ["Client"]
