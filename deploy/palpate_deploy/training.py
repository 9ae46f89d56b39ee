"""The commands of the training room, which needs an extra that a station does not have."""

from __future__ import annotations

from typing import Any

import typer

from palpate.errors import MissingExtraError

EXTRA_MODULES = ("torch", "onnx", "h5py", "matplotlib")
"""What ``palpate[training]`` installs and a bare palpate has not."""


class _LazyGroup(typer.core.TyperGroup):
    """A group whose commands are imported when they are asked for, not when palpate starts."""

    room = ""

    @property  # type: ignore[override]
    def commands(self) -> dict[str, Any]:
        """The room's commands.

        Raises:
            MissingExtraError: The training extra is not installed.
        """
        found: dict[str, Any] = typer.main.get_command(_app(self.room)).commands  # type: ignore[attr-defined]
        return {**found, **self.joined()}

    @commands.setter
    def commands(self, value: dict[str, Any]) -> None:
        """Typer gives the commands it knows of at the start: none."""

    def joined(self) -> dict[str, Any]:
        """Commands that join this room with others, which only deploy may."""
        return {}


class _TrainGroup(_LazyGroup):
    room = "train"


class _DataGroup(_LazyGroup):
    room = "data"

    def joined(self) -> dict[str, Any]:
        """What needs finite elements to simulate the skin, and training for all else."""
        from palpate_deploy.cli_generate import generate_app, sample_app
        from palpate_deploy.cli_plan import plan_app
        from palpate_deploy.cli_process import process_app

        return {
            "generate": typer.main.get_command(generate_app),
            "plan": typer.main.get_command(plan_app),
            "process": typer.main.get_command(process_app),
            "sample": typer.main.get_command(sample_app),
        }


train = typer.Typer(
    cls=_TrainGroup,
    help="Train, evaluate and export networks (needs palpate[training]).",
    no_args_is_help=True,
)
data = typer.Typer(
    cls=_DataGroup,
    help="Data sets: ingest, split, inspect (needs palpate[training]).",
    no_args_is_help=True,
)
for _app_of_room in (train, data):
    # A group without a callback and with a single command would become that command.
    _app_of_room.callback()(lambda: None)


def _app(room: str) -> typer.Typer:
    """The training room's own app.

    Raises:
        MissingExtraError: The training extra is not installed.
    """
    try:
        from palpate_training.cli.__init__ import data_app, train_app
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in EXTRA_MODULES:
            raise MissingExtraError(missing, extra="training") from error
        raise
    return train_app if room == "train" else data_app
