"""The command that shows a view, as a newcomer can type it."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path


def viewer_command(view: Path) -> str:
    """``rerun FILE``, with the folder of ``rerun`` where it is not on the path."""
    rerun = Path(sys.executable).with_name("rerun")
    if shutil.which("rerun") is None and rerun.exists():
        near = os.path.relpath(rerun)
        return f"{rerun if near.startswith('..') else near} {view}"
    return f"rerun {view}"
