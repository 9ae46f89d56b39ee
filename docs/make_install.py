"""Write docs/results/install.md from docs/results/install.json.

``python docs/make_install.py``          writes the page
``python docs/make_install.py --check``  exits 1 if the page is not what the file says

``make debian`` measures everything anew.
"""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
_table: Callable[[str, Iterable[Iterable[str]]], str] = FRESH["table"]
FILE = Path(__file__).parent / "results" / "install.json"
PAGE = FILE.with_suffix(".md")

PARTS = {
    "image": "The Debian",
    "chroot": "Without systemd: the units' commands as the units say",
    "containers": "Containers",
    "systemd": "Under a systemd that runs",
}

HEAD = """# Install: from a Debian with only Python to nothing left

What an installation writes, how far its units are shut off from the host, and what an uninstall
leaves. Made by `make debian`, which needs root, debootstrap and a network, and by
`python docs/make_install.py`.
How to install: [install.md](../install.md).
"""


def _steps(values: dict[str, Any], part: str) -> str:
    rows = [
        (one["step"], f"{one['seconds']:.1f}") for one in values["steps"] if one["part"] == part
    ]
    return _table("step | s", rows)


def _list(lines: list[str]) -> str:
    return ", ".join(f"`{line}`" for line in lines) or "nothing"


def _chroot(values: dict[str, Any]) -> str:
    return (
        f"{_steps(values, 'chroot')}\n"
        "The commands ran as a user without rights, on a system that is read-only except for the "
        "station's folders, with loopback as the only network. The robot got "
        f"{values['estimates']} estimates, the simulation ended with `{values['simulation']}`, "
        f"{values['recorded_bytes'] / 1e6:.1f} MB "
        "were recorded.\n\n`palpate install` made: "
        f"{_list([line[2:] for line in values['written']])}.\n\n"
        f"Left by `palpate uninstall --purge`: {_list(values['left_by_uninstall'])}. Left after "
        "`rm -r /opt/palpate`: "
        f"{_list(values['left_at_all'])}. Every file, folder and link of the Debian is compared, "
        "with rights, owner and content.\n"
    )


def _containers(values: dict[str, Any]) -> str:
    image, quadlets = values["image"], values["quadlets"]
    return (
        f"{_steps(values, 'containers')}\n"
        f"The {image['commands']} commands of the Dockerfile run; the image has "
        f"{image['bytes'] / 1e9:.1f} GB. The command of `compose.yaml` in it is "
        f"healthy after {image['healthy_s']} s, by its own health check. The generator of podman "
        f"{quadlets['podman']} makes "
        f"{_list(quadlets['units'])} of the quadlets (status {quadlets['status']}) and complains "
        f"about {_list(quadlets['complaints'])}. "
        "No container was started: there was no engine.\n"
    )


def _systemd(values: dict[str, Any]) -> str:
    found = values["booted"]
    if "not_tried" in found:
        return f"Not tried on this host: {found['not_tried']}.\n"
    hung = ", ".join(f"{name} {seconds} s" for name, seconds in found["hung"].items())
    ways = {True: "yes", False: "**no**"}
    rows = [
        ("the robot's estimates; the simulation", f"{found['estimates']}; {found['simulation']}"),
        ("the gateway stays on one core", ways[found["one_core"]]),
        ("stopped (SIGSTOP) until it works again", hung),
        (
            "a wrong profile",
            f"{found['wrong_profile']}, started again {found['wrong_profile_starts']} times",
        ),
        (
            "upgrade, rollback: the unit runs the new, the old command",
            f"{ways[found['upgraded']]}, {ways[found['rolled_back']]}",
        ),
        ("closed records that outlived restarts and both", str(found["records"])),
        ("left by `palpate uninstall --purge`", _list([*found["units_left"], *found["left"]])),
    ]
    return (
        f"{_steps(values, 'systemd')}\nsystemd {found['systemd']} is process 1 of namespaces of "
        "its own, and starts the units with their system calls, mounts, user and watchdog. Limits "
        "of memory and tasks, and the filters of addresses and devices, hang on the control groups "
        f"of the kernel: whether they hold was not measured here.\n\n{_table('what | found', rows)}"
    )


def _scores(values: dict[str, Any]) -> str:
    scores = values["scores"]
    rows = [
        (case, f"{found['palpate']}", str(found.get("palpate-fem", "-")))
        for case, found in scores.items()
        if case != "bare"
    ]
    return (
        "`systemd-analyze security --offline=true`: 0 = closed, 10 = open; the goal is 1.5, a "
        "unit with nothing but its command has "
        f"{scores['bare']['palpate']}. The profiles are those of `tests/install/cases.py`: what "
        "they name has to be allowed. "
        f"Only the finite elements may have memory that is both writable and executable.\n\n"
        f"{_table('profile | palpate@ | palpate-fem@', rows)}"
    )


def page(values: dict[str, Any]) -> str:
    """The page of a result."""
    where = (
        f"Debian {values['debian']}, Python {values['python']}, palpate {values['palpate']}, "
        f"{values['cores']} shared cores, "
        f"{values['machine']}. Times are of one run, with other work on the machine.\n"
    )
    texts = {
        "image": _steps(values, "image"),
        "chroot": _chroot(values),
        "containers": _containers(values),
        "systemd": _systemd(values),
    }
    parts = "".join(f"\n## {title}\n\n{texts[part]}" for part, title in PARTS.items())
    return f"{HEAD}\n{where}\n## How closed the units are\n\n{_scores(values)}{parts}"


if __name__ == "__main__":
    text = page(json.loads(FILE.read_text(encoding="utf-8")))
    sys.exit(FRESH["write_or_check"]({PAGE: text}))
