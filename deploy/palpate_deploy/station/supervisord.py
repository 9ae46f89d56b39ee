"""The process manager's process: supervisord, bound to the ``palpate`` that started it.

``python -m palpate_deploy.station.supervisord -n -s -c FILE`` is ``supervisord`` with two
differences: it stops, and stops its processes, when its parent is gone; and it notices a dead
process within a tenth of a second instead of a second, which is a third of the time a restart may
take.
"""

from __future__ import annotations

import os
import sys
from typing import Any

from supervisor.options import ServerOptions
from supervisor.poller import Poller
from supervisor.supervisord import go

from palpate_deploy.station.lifetime import PARENT_PID, end_with_parent

_WAIT_S = 0.1


class _PromptPoller(Poller):  # type: ignore[misc]  # supervisor has no types
    def poll(self, timeout: float) -> Any:
        return super().poll(min(timeout, _WAIT_S))


def main() -> None:
    """Run supervisord with the arguments of this process."""
    end_with_parent()
    os.environ[PARENT_PID] = str(os.getpid())  # its processes live by it
    options = ServerOptions()
    options.poller = _PromptPoller(options)
    options.realize(sys.argv[1:], doc=__doc__)
    options.first = True
    options.test = False
    go(options)
    options.close_httpservers()
    options.close_logger()


if __name__ == "__main__":
    main()
