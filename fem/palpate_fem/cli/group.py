"""What all finite-element commands do when a package is missing: say which extra brings it."""

from __future__ import annotations

import typer

from palpate.errors import MissingExtraError

EXTRA_MODULES = ("scipy", "warp", "pymetis", "threadpoolctl", "h5py", "matplotlib")
"""What ``palpate[fem]`` installs and a bare palpate has not."""


class FemGroup(typer.core.TyperGroup):
    """A group whose commands say which extra is missing."""

    def invoke(self, ctx: typer.Context) -> object:  # type: ignore[override]
        """Run the command that was given."""
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing in EXTRA_MODULES:
                raise MissingExtraError(missing, extra="fem") from error
            raise
