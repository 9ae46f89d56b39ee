"""What an emulated device measures: the twin, nothing, or a slow press."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import typer

from palpate_gateway.emulators.emulator import WrenchSource, no_load, slow_press

if TYPE_CHECKING:
    from palpate_gateway.emulators.biotac_slots import CountSource
    from palpate_gateway.emulators.twin import Loop

_PATIENCE_S = 2.0


@dataclass(frozen=True, slots=True)
class Playing:
    """What the user wants to be played.

    Attributes:
        play: The digital twin, an untouched finger, or a slow press without physics.
        seed: Of the twin's first finger.
        trajectories: The twin's presses; () = all.
        epoch_s: When the twin's loops begin [s since 1970].
        unit: The twin's unit, by name or number; "" = another for each seed.
    """

    play: Literal["twin", "idle", "press"] = "twin"
    seed: int = 0
    trajectories: tuple[str, ...] = ()
    epoch_s: float = 0.0
    unit: str = ""

    def counts(self, fingers: int) -> CountSource:
        """What BioTacs measure.

        Raises:
            ConfigError: The twin has no such unit or trajectory.
        """
        from palpate_gateway.emulators.biotac_slots import idle_counts, press_counts

        if self.play != "twin":
            return idle_counts if self.play == "idle" else press_counts
        from palpate_gateway.emulators.twin import TwinCounts

        return TwinCounts([self._loop(finger, fingers) for finger in range(fingers)], self.epoch_s)

    def wrench(self, finger: int = 0) -> WrenchSource:
        """What the sensor under a finger feels.

        Raises:
            ConfigError: The twin has no such trajectory.
        """
        if self.play != "twin":
            return no_load if self.play == "idle" else slow_press
        from palpate_gateway.emulators.twin import TwinWrench

        return TwinWrench(self._loop(finger, 1), self.epoch_s)

    def _loop(self, finger: int, fingers: int) -> Loop:
        from palpate_gateway.emulators.twin import loop_options, make_loop

        told_s = time.monotonic() + _PATIENCE_S

        def tell(share: float) -> None:
            nonlocal told_s
            if time.monotonic() > told_s:
                told_s = time.monotonic() + _PATIENCE_S
                of = f" of finger {finger + 1} of {fingers}" if fingers > 1 else ""
                typer.echo(f"the twin is computed: {100 * share:.0f} %{of}", err=True)

        unit = int(self.unit) if self.unit.isdecimal() else self.unit
        options = loop_options(
            finger, unit=unit or 0, trajectories=self.trajectories, seed=self.seed
        )
        return make_loop(options, tell)
