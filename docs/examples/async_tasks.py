"""Tasks of one event loop: one follows a finger, one asks about the station, one is cancelled.

With a station without hardware:

    palpate up --profile virtual            # in one terminal
    python docs/examples/async_tasks.py     # in another: 300 estimates, or so many as are given
"""

from __future__ import annotations

import asyncio
import sys

from palpate import AsyncClient
from palpate.errors import PalpateError


async def follow(robot: AsyncClient, count: int) -> None:
    """Print the force of every 25th estimate."""
    seen = 0
    async with robot.stream_features("finger") as estimates:
        async for estimate in estimates:
            seen += 1
            if seen % 25 == 0:
                print(f"{seen:6}: {estimate.force} N")
            if seen == count:
                return


async def describe(robot: AsyncClient) -> None:
    """Say what serves."""
    model = await robot.model()
    print(f"served by {model.name} version {model.version}")


async def wait_for_another(robot: AsyncClient) -> None:
    """Wait for a sensor that does not exist, until this task is cancelled."""
    async for _ in robot.stream_features("no-such-finger", timeout_s=None):
        print("there it is")


async def main(count: int) -> None:
    """Three tasks at once; leaving ``async with`` ends what still waits."""
    try:
        async with AsyncClient() as robot:
            waiting = asyncio.create_task(wait_for_another(robot))
            await asyncio.gather(follow(robot, count), describe(robot))
            waiting.cancel()
    except PalpateError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]) if len(sys.argv) > 1 else 300))
