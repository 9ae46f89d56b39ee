"""The trial of a foreign bundle: its first runs happen in a process that may hang or die.

A graph can loop without end or ask for all memory, already while it is loaded. So a bundle that
does not ship with palpate is loaded, compared with its golden vectors and warmed up by a child that
the kernel ends after ``LIMIT_S``, and whose memory is limited. The child answers with the bundle's
digest; the service then loads the very bytes that it has read and hashed itself.
"""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
from pathlib import Path

from palpate.errors import BundleError, PalpateError, printable
from palpate.files.bundle import Bundle, read_bundle
from palpate.process import require
from palpate_services.inference.model import load
from palpate_services.inference.repository import ships

LIMIT_S = 5.0
"""Time to load, to compare with the golden vectors and to warm up [s]; those that ship need 0.2."""

MEMORY_BYTES = 192 << 20
"""Memory for the model's values [bytes], in addition to ``_COPIES`` of its files."""

_COPIES = 6  # ONNX Runtime holds the file, its parsed form and packed weights at the same time
_START_S = 30.0
"""Longest time to start the child on a busy host, before its own limit begins [s]."""

_REMEDY = "serve another bundle, or tell its maker"
_NO_MEMORY = ("bad_alloc", "allocate memory", "bfc_arena")


def proven(bundle: Bundle, task: str, *, limit_s: float = LIMIT_S) -> Bundle:
    """The bundle, after a child process could load and run it; at once for one that ships.

    Raises:
        BundleError: It breaks its contract, does not end within ``limit_s``, needs too much memory,
            ends the process that runs it, or was exchanged meanwhile.
        MissingExtraError: ONNX Runtime is not installed.
    """
    if ships(bundle.folder):
        return bundle
    label = f"bundle {bundle.manifest.name}:{bundle.manifest.version}"
    # -P: no module may come from the working directory.
    words = [sys.executable, "-P", "-m", __name__, str(bundle.folder), task, str(limit_s)]
    try:
        child = subprocess.run(
            words, capture_output=True, text=True, timeout=_START_S + limit_s, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise BundleError(
            f"{label}: its trial did not start within {_START_S:g} s",
            remedy="this host is too busy; try again",
        ) from error
    if child.returncode == -signal.SIGALRM:
        raise BundleError(
            f"{label}: the model did not finish its golden vectors within {limit_s:g} s",
            remedy=_REMEDY,
        )
    if child.returncode < 0:
        name = signal.Signals(-child.returncode).name
        raise BundleError(f"{label}: the model ended its trial by {name}", remedy=_REMEDY)
    try:
        answer = json.loads(child.stdout.splitlines()[-1])
    except (IndexError, ValueError) as error:
        last = printable((child.stderr.strip().splitlines() or ["no output"])[-1])
        raise BundleError(f"{label}: its trial failed: {last}", remedy=_REMEDY) from error
    if "problem" in answer:
        raise BundleError(answer["problem"], remedy=answer["remedy"])
    if answer["sha256"] != bundle.sha256.hex():
        raise BundleError(
            f"{label}: {bundle.folder} was exchanged while it was tried",
            remedy="do not edit bundles; write the next version",
        )
    return bundle


def _try(folder: Path, task: str, limit_s: float) -> dict[str, str]:
    """Read, load and warm up a bundle, under limits that end this process."""
    try:
        require("onnxruntime", extra="services")  # its libraries need memory, and time to load
        bundle = read_bundle(folder)
        allowed = MEMORY_BYTES + _COPIES * len(bundle.model)
        _limit_memory(allowed)
        # The default action of SIGALRM ends the process, also inside a native call.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, limit_s)
        try:
            load(bundle, task)
        except MemoryError as error:
            raise _too_large(bundle, allowed) from error
        except BundleError as error:
            if any(word in str(error.__cause__) for word in _NO_MEMORY):
                raise _too_large(bundle, allowed) from error
            raise
    except PalpateError as error:
        return {"problem": error.problem, "remedy": error.remedy}
    return {"sha256": bundle.sha256.hex()}


def _too_large(bundle: Bundle, allowed: int) -> BundleError:
    return BundleError(
        f"bundle {bundle.manifest.name}:{bundle.manifest.version}: the model needs more than "
        f"{allowed >> 20} MiB of memory",
        remedy=_REMEDY,
    )


def _limit_memory(more_bytes: int) -> None:
    """Limit what this process can allocate to what it has and ``more_bytes``."""
    # Data, not address space: ONNX Runtime reserves much of the latter and never uses it.
    lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
    (data,) = (int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:"))
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (data + more_bytes, hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    answer = _try(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]))
    sys.stdout.write(json.dumps(answer) + "\n")
