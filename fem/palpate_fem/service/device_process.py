"""The process of a device, as whoever gives it trajectories sees it; and the devices there are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from palpate.errors import ConfigError
from palpate.heartbeat import Turns
from palpate_fem.service.channel import ChildProcess
from palpate_fem.service.jobs import (
    DeviceEvent,
    DeviceReady,
    DeviceSetup,
    JobFailed,
    NumberedPress,
    Swept,
)

HANG_S = 120.0
"""Longest time between two sweeps of slots [s]; they take seconds."""

START_S = 900.0
"""The same before a process, a worker's too, is ready [s]: kernels are compiled until then, which
takes minutes."""

ON_CLUSTER = ("cuda", "cpu")
"""Devices of a cluster: each of its GPUs, or for tests its CPUs."""

AUTO = "auto"
"""Instead of a device: the first GPU, or none."""

Owner = TypeVar("Owner")
"""What a trajectory is for whoever gave it."""


def check_devices(names: Sequence[str]) -> None:
    """Check that Warp sees these devices, e.g. ``cuda:0``.

    Raises:
        ConfigError: It does not see one of them; lists those that it sees.
    """
    from palpate_fem.device import known_devices

    known = known_devices()
    for name in names:
        if name not in known:
            raise ConfigError(
                f"there is no device {name!r}",
                remedy=f"give one of: {', '.join(known)}; if a GPU is missing, see nvidia-smi",
            )


def check_places(devices: Sequence[str], slots: int | None, ray: str | None) -> None:
    """Check the options ``--device``, ``--slots`` and ``--ray`` of a command.

    Raises:
        ConfigError: They cannot be meant together, or there is no such device.
    """
    if slots is not None and not devices:
        raise ConfigError(
            "--slots without --device",
            remedy="name the device, e.g. --device cuda" + ("" if ray is not None else ":0"),
        )
    if ray is None:
        check_devices(devices)
    elif devices and (len(devices) > 1 or devices[0] not in ON_CLUSTER):
        raise ConfigError(
            f"--device {' and '.join(devices)} with --ray",
            remedy="give cuda: it means every GPU of the cluster; or leave it out for its CPUs",
        )


def wanted_device(name: str | None) -> str | None:
    """The device that a name or `AUTO` means; None = the CPU, one trajectory at a time.

    Raises:
        ConfigError: There is no such device.
    """
    if name == AUTO:
        from palpate_fem.device import known_devices

        return next((one for one in known_devices() if one.startswith("cuda")), None)
    if name is not None:
        check_devices([name])
    return name


class DeviceProcess(ChildProcess, Generic[Owner]):
    """The process of a device.

    Args:
        setup: What it solves, and where.
        threads: Threads that its libraries may use.
        on_event: Called with each event, and with None when it has ended, from a thread of its own.
        hang_s: It is ended if it should be at work and is silent for so long [s].
        start_s: The same before its device is ready [s].

    Attributes:
        device: Its Warp device.
        open: The trajectories that it has, by number.
        ready: Whether it takes trajectories; kept up to date by whoever gives them.
        warm: Whether its device is ready, too.
        last_words: Why it ends, if it said so; kept likewise.
        hung: Whether it was ended because it was silent.
    """

    def __init__(
        self,
        setup: DeviceSetup,
        threads: int,
        on_event: Callable[[DeviceProcess[Owner], DeviceEvent | None], None],
        *,
        hang_s: float = HANG_S,
        start_s: float = START_S,
    ) -> None:
        self.device = setup.device
        self.open: dict[int, Owner] = {}
        self.ready = self.warm = self.hung = False
        self.last_words: JobFailed | None = None
        self._on_event, self._hang_s, self._patience_s = on_event, hang_s, start_s
        self._turns = Turns()
        self._turns.next(start_s)
        super().__init__(
            "palpate_fem.service.device_worker",
            setup,
            threads=threads,
            on_message=DeviceProcess._on_message_of_device,
            on_gone=lambda process: on_event(process, None),
        )

    def give(self, press: NumberedPress, owner: Owner) -> None:
        """Give it a trajectory."""
        if not self.open:  # it need not have said anything while it had nothing to do
            self._turns.next(self._patience_s)
        self.open[press.number] = owner
        self.send(press)

    def end_if_hung(self) -> None:
        """End it if it should be at work and has been silent for too long; to be asked often."""
        if not self.hung and (self.open or not self.ready) and self._turns.are_late():
            self.hung = True
            self.kill()

    def why_it_ended(self) -> str:
        """The end of an error message."""
        if self.last_words is not None:
            return f"ended: {self.last_words.problem}"
        if self.hung:
            return f"was ended as it had been silent for {self._patience_s:g} s"
        return self.how_it_ended()

    def _on_message_of_device(self, event: DeviceEvent) -> None:
        if isinstance(event, DeviceReady):
            self.warm, self._patience_s = True, self._hang_s
        self._turns.next(self._patience_s)
        if not isinstance(event, Swept):
            self._on_event(self, event)
