"""``palpate fem export``: a store of simulations as one file."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from palpate.command import typed_command
from palpate.errors import ConfigError
from palpate_fem.cli.show import progress_bar
from palpate_fem.store.export import export
from palpate_fem.store.read import SimulationStore

SUFFIX = ".h5"


def export_command(store: Path, out: Path) -> int:
    """Read a store against its checksums, copy it into one file and say what is in it.

    Returns:
        0.

    Raises:
        ConfigError: ``out`` is there already, or is not called ``.h5``.
        DatasetError: ``store`` is none, is one file already, or is damaged.
        StoreDiskError: The disk is full or refuses.
    """
    if out.suffix != SUFFIX:
        raise ConfigError(f"{out} does not end in {SUFFIX}", remedy=f"call it {out.stem}{SUFFIX}")
    if out.exists():
        raise ConfigError(f"{out} is there already", remedy="name another file, or remove it")
    opened = SimulationStore.open(store)
    with progress_bar() as bar:
        task = bar.add_task("check", total=None)
        # Copying takes damaged bytes over as they are; whoever gets the file could not mend it.
        opened.fingertip()
        opened.check()
        bar.update(task, description="copy")
        count = export(
            opened,
            out,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
            command=typed_command(),
        )
    size_mb = out.stat().st_size / 1e6
    Console().print(
        f"{out}: {count} trajectories, {size_mb:.1f} MB",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    return 0
