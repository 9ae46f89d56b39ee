"""What every room of palpate shares: messages, wire codec, bus, files, and the robot's client.

A robot needs one name::

    from palpate import Client        # or AsyncClient, for asyncio
"""

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.client import Client
    from palpate.client.aio import AsyncClient

    __version__: str

__all__ = ["AsyncClient", "Client", "__version__"]


def __getattr__(name: str) -> Any:
    # Loaded on demand, so that `palpate --help` and pure data modules start without Zenoh.
    if name == "Client":
        from palpate.client import Client

        return Client
    if name == "AsyncClient":
        from palpate.client.aio import AsyncClient

        return AsyncClient
    if name == "__version__":
        try:
            return version("palpate")
        except PackageNotFoundError:  # a checkout that is not installed
            return "unknown"
    raise AttributeError(f"module 'palpate' has no attribute {name!r}")
