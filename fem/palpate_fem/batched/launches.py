"""Launches that are kept: to pack twenty arguments takes longer than many a kernel.

For one slot even that is too slow: there, on a GPU, a sequence of launches is kept as a graph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import warp as wp

from palpate_fem.batched.dense_tiles import THREADS

KEPT = 2000
"""Launches that are kept: several times those of a sweep."""

KEPT_GRAPHS = 500
"""Graphs that are kept: of a slot on its own it takes about ten."""


class Launches:
    """Launches kernels on a device; one with the arguments of before is used again.

    Lists of integers, such as the slots to work on, may be other ones.
    """

    def __init__(self, device: str) -> None:
        self._device = device
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
                device=self._device,
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


class Sequences:
    """Runs functions that do nothing but launch; for one slot on a GPU, as graphs."""

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._graphs: dict[Any, tuple[wp.Graph | None, Any]] = {}

    def __call__(
        self, slots: wp.array, launch: Callable[..., object], *arguments: Any, **named: Any
    ) -> None:
        """Run a function.

        Args:
            slots: Those it launches for; a graph is made and used where it is one.
            launch: It must do nothing else, wait for nothing, and launch the same with the same
                arguments, whose contents may change. A graph may hold others that it calls.
            arguments: Of the function.
            named: Of the function.
        """
        if len(slots) != 1 or not self._device.is_cuda or self._device.is_capturing:
            launch(*arguments, **named)
            return
        of = [*arguments, *(part for pair in sorted(named.items()) for part in pair)]
        key = (launch, *((one if isinstance(one, int | float | str) else id(one)) for one in of))
        if key not in self._graphs:  # the first time it compiles what it needs
            launch(*arguments, **named)
            if len(self._graphs) == KEPT_GRAPHS:
                self._graphs.clear()
            self._graphs[key] = None, of  # kept, so that no other gets an id of these
            return
        graph, _ = self._graphs[key]
        if graph is None:
            with wp.ScopedCapture(self._device) as capture:
                launch(*arguments, **named)
            graph = capture.graph
            self._graphs[key] = graph, of
        wp.capture_launch(graph)


@dataclass(slots=True)
class _KeptLaunch:
    """A launch, its arguments, which it keeps alive, and the places of lists of integers."""

    command: wp.Launch
    dim: int | tuple[int, ...]
    arguments: list[Any]
    lists: list[int]


def _is_list(argument: Any) -> bool:
    return isinstance(argument, wp.array) and argument.dtype is wp.int32 and argument.ndim == 1


def _identity(argument: Any) -> Any:
    """What tells arguments apart: numbers, and where arrays are; nothing for lists of integers."""
    if isinstance(argument, wp.array):
        return None if _is_list(argument) else (argument.ptr, argument.shape)
    if isinstance(argument, int | float):
        return argument
    value = getattr(argument, "value", None)  # of a number of Warp's own
    return id(argument) if value is None else value  # it is kept, so that no other gets its id
