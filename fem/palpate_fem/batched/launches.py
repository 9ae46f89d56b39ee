"""Launches of kernels that are kept: to pack twenty arguments takes longer than many a kernel."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from palpate_fem.batched.dense_tiles import THREADS

KEPT = 2000
"""Launches that are kept: several times those of a sweep."""


class Launches:
    """Launches kernels on a device; one with the arguments of before is used again.

    Lists of integers, such as the slots to work on, may be other ones.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._kept: dict[Any, tuple[wp.Launch, Any, list[Any]]] = {}

    def __call__(
        self,
        kernel: wp.Kernel,
        dim: Any,
        inputs: list[Any],
        outputs: list[Any],
    ) -> None:
        """Run a kernel with ``dim`` threads; none = nothing happens.

        Args:
            kernel: A kernel; all have blocks of `THREADS`, so that modules are compiled once.
            dim: Number of threads, or of each dimension.
            inputs: Its first arguments.
            outputs: The others.
        """
        if not np.prod(dim):
            return
        arguments = [*inputs, *outputs]
        key = (kernel.module.name, kernel.key, *map(_identity, arguments))
        kept = self._kept.get(key)
        if kept is None:
            command = wp.launch(
                kernel,
                dim=dim,
                inputs=inputs,
                outputs=outputs,
                block_dim=THREADS,
                device=self._device,
                record_cmd=True,
            )
            if len(self._kept) == KEPT:  # of callers with ever new arrays
                self._kept.clear()
        else:
            command, known_dim, known = kept
            if known_dim != dim:
                command.set_dim(dim)
            for place, (now, before) in enumerate(zip(arguments, known, strict=True)):
                if now is not before and _is_list(now):
                    command.set_param_at_index(place, now)
        self._kept[key] = command, dim, arguments
        command.launch()


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
