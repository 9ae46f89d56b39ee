"""The client of a robot: current estimates, streams, simulations, tare, presence, its own pose.

For asyncio: ``palpate.client.aio``.
"""

from palpate.client.robot import Client
from palpate.client.streams import Stream, Watch

__all__ = ["Client", "Stream", "Watch"]
