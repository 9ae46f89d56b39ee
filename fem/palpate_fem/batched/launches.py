"""Launches that are kept: to pack twenty arguments takes longer than many a kernel.

For few slots even that is too slow: there, on a GPU, a sequence of launches is kept as a graph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from palpate_fem.arrays import Ints
from palpate_fem.batched import kernels
from palpate_fem.batched.dense_tiles import THREADS

KEPT = 2000
"""Launches that are kept: several times those of a sweep."""

FEW = 16
"""Slots for which graphs are made: with more, kernels take longer than their launches."""

KEPT_GRAPHS = 500
"""Graphs that each `Sequences` keeps: 64 presses in sixteen slots made 180 of the most."""


class Launches:
    """Launches kernels on a device; one with the arguments of before is used again.

    Lists of integers, such as the slots to work on, may be other ones.
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self._kept: dict[Any, _KeptLaunch] = {}

    def __call__(
        self,
        kernel: wp.Kernel,
        dim: int | tuple[int, ...],
        inputs: list[Any],
        outputs: list[Any],
        *,
        block: int = THREADS,
    ) -> None:
        """Run a kernel with ``dim`` threads; none = nothing happens.

        Args:
            kernel: A kernel.
            dim: Number of threads, or of each dimension.
            inputs: Its first arguments.
            outputs: The others.
            block: Threads of a block; a module is compiled once for each number.
        """
        if dim == 0 or (isinstance(dim, tuple) and 0 in dim):
            return
        arguments = [*inputs, *outputs]
        key = (kernel, block, *map(_identity, arguments))
        kept = self._kept.get(key)
        if kept is None:
            command = wp.launch(
                kernel,
                dim=dim,
                inputs=inputs,
                outputs=outputs,
                block_dim=block,
                device=self.device,
                record_cmd=True,
            )
            if len(self._kept) == KEPT:  # of callers with ever new arrays
                self._kept.clear()
            places = [place for place, one in enumerate(arguments) if _is_list(one)]
            self._kept[key] = _KeptLaunch(command, dim, arguments, places)
        else:
            command = kept.command
            if kept.dim != dim:
                command.set_dim(dim)
                kept.dim = dim
            for place in kept.lists:
                now = arguments[place]
                if now is not kept.arguments[place]:
                    command.set_param_at_index(place, now)
                    kept.arguments[place] = now
        command.launch()


class Listed:
    """Slots to work on, and all that belongs to them; it is listed when it is first asked for.

    Attributes:
        numbers: The slots, (m,).
    """

    def __init__(self, numbers: Ints, each: tuple[int, int, int], launch: Launches) -> None:
        """Note what to list.

        Args:
            numbers: The slots, (m,).
            each: Number of elements, of outer and of inner faces of each.
            launch: On their device.
        """
        self.numbers, self.each, self._launch = np.asarray(numbers, np.int32), each, launch
        self._lists: list[wp.array] | None = None

    @property
    def slots(self) -> wp.array:
        """The same on the device."""
        return self._listed()[0]

    @property
    def elements(self) -> wp.array:
        """Numbers of their elements."""
        return self._listed()[1]

    @property
    def outer(self) -> wp.array:
        """Numbers of their outer faces."""
        return self._listed()[2]

    @property
    def inner(self) -> wp.array:
        """Numbers of their inner faces."""
        return self._listed()[3]

    def like(self) -> Listed:
        """Lists of as many slots, for `change`."""
        other = Listed(self.numbers, self.each, self._launch)
        other._listed()  # a graph that is being made could not
        return other

    def change(self, numbers: Ints) -> None:
        """List as many other slots; `expand` does the rest."""
        self.numbers = numbers
        if len(numbers):
            self.slots.assign(numbers)

    def expand(self) -> None:
        """Find what belongs to the slots."""
        slots, *lists = self._listed()
        # One element of all slots after the other: neighbouring threads share its constants. Of
        # faces one slot after the other: where a face touches, its neighbours do.
        ways = (kernels.expand_across, kernels.expand, kernels.expand)
        for way, count, items in zip(ways, self.each, lists, strict=True):
            self._launch(way, (len(slots), count), [slots, count], [items])

    def _listed(self) -> list[wp.array]:
        if self._lists is None:
            device = self._launch.device
            self._lists = [wp.array(self.numbers, dtype=wp.int32, device=device)]
            for count in self.each:
                size = len(self.numbers) * count
                self._lists.append(wp.empty(size, dtype=wp.int32, device=device))
            self.expand()
        return self._lists


class Sequences:
    """Runs functions that do nothing but launch; for few slots on a GPU, as graphs.

    A graph belongs to numbers of slots, not to the slots: it reads lists of its own, into which
    those of a call are copied.
    """

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._graphs: dict[Any, _KeptGraph] = {}
        self._own: dict[Any, Any] = {}

    def __call__(self, launch: Callable[..., object], *arguments: Any) -> None:
        """Run a function.

        Args:
            launch: It must do nothing else, wait for nothing, and launch the same with the same
                arguments, whose contents may change, and with other lists of as many slots. A
                graph may hold others that it calls.
            arguments: Of the function.
        """
        cuda = self._device.is_cuda and not self._device.is_capturing
        if not cuda or any((_slots(one) or 0) > FEW for one in arguments):
            launch(*arguments)
            return
        key = (launch, *map(_kind, arguments))
        kept = self._graphs.get(key)
        if kept is None:  # the first time it compiles what it needs
            launch(*arguments)
            if len(self._graphs) == KEPT_GRAPHS:
                self._graphs.clear()
            self._graphs[key] = _KeptGraph(None, arguments)
            return
        if kept.graph is None:
            kept.arguments = tuple(map(self._own_list, range(len(arguments)), arguments))
            with wp.ScopedCapture(self._device) as capture:
                for own in kept.arguments:
                    if isinstance(own, Listed):
                        own.expand()
                launch(*kept.arguments)
            kept.graph = capture.graph
        for own, given in zip(kept.arguments, arguments, strict=True):
            if isinstance(given, Listed):
                own.change(given.numbers)
            elif _is_list(given):
                wp.copy(own, given)
        wp.capture_launch(kept.graph)

    def _own_list(self, place: int, argument: Any) -> Any:
        """A list like an argument, which all graphs share at this place; others as they are."""
        if (count := _slots(argument)) is None:
            return argument
        key = (place, type(argument), count)
        if key not in self._own:
            listed = isinstance(argument, Listed)
            self._own[key] = argument.like() if listed else wp.empty_like(argument)
        return self._own[key]


@dataclass(slots=True)
class _KeptGraph:
    """A graph, made at the second call, and its arguments, which it keeps alive."""

    graph: wp.Graph | None
    arguments: tuple[Any, ...]


@dataclass(slots=True)
class _KeptLaunch:
    """A launch, its arguments, which it keeps alive, and the places of lists of integers."""

    command: wp.Launch
    dim: int | tuple[int, ...]
    arguments: list[Any]
    lists: list[int]


def _is_list(argument: Any) -> bool:
    return isinstance(argument, wp.array) and argument.dtype is wp.int32 and argument.ndim == 1


def _slots(argument: Any) -> int | None:
    """Of a list of slots how many there are; None for all else."""
    if isinstance(argument, Listed):
        return len(argument.numbers)
    return len(argument) if _is_list(argument) else None


def _kind(argument: Any) -> Any:
    """What tells arguments of a graph apart; it is kept, so that no other gets its id."""
    if (count := _slots(argument)) is not None:
        return type(argument), count
    return argument if isinstance(argument, int | float | str) else id(argument)


def _identity(argument: Any) -> Any:
    """What tells arguments apart: numbers, and where arrays are; nothing for lists of integers."""
    if isinstance(argument, wp.array):
        return None if _is_list(argument) else (argument.ptr, argument.shape)
    if isinstance(argument, int | float):
        return argument
    value = getattr(argument, "value", None)  # of a number of Warp's own
    return id(argument) if value is None else value  # it is kept, so that no other gets its id
