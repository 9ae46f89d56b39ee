"""What a robot uses: estimates now, simulations, tare, who is alive, telling its own pose."""

from palpate.client.robot import Client

__all__ = ["Client"]
