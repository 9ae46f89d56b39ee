"""The device of the Warp kernels, and NumPy arrays as Warp arrays without a copy."""

from __future__ import annotations

import os
import tempfile
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

# Otherwise Warp prints its version, the devices and each kernel that it loads on standard output.
wp.config.log_level = wp.LOG_ERROR

DEVICE = "cpu"

_NO_GPU = b"GPU execution will not be available"


def _start() -> None:
    """Start Warp without its warning that this machine has no GPU, which is not needed.

    Its native code writes the warning to file descriptor 2 at every log level (Warp 1.19,
    `init_cuda_driver`). Everything else that it writes is passed on.
    """
    try:
        stderr = os.dup(2)
    except OSError:  # stderr is closed, so there is nothing to filter
        wp.init()
        return
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            said.seek(0)
            for line in said:
                if _NO_GPU not in line:
                    os.write(2, line)


_start()


def scalars(array: NDArray[np.float64]) -> wp.array:
    """A float64 array of any shape."""
    return wp.array(array, dtype=wp.float64, device=DEVICE, copy=False)


def indices(array: NDArray[np.int32]) -> wp.array:
    """An int32 array of any shape."""
    return wp.array(array, dtype=wp.int32, device=DEVICE, copy=False)


def truths(array: NDArray[np.bool_]) -> wp.array:
    """A bool array of any shape."""
    return wp.array(array, dtype=wp.bool, device=DEVICE, copy=False)


def vec3s(array: NDArray[np.float64]) -> wp.array:
    """An array of 3-vectors; the last axis is the vector."""
    return wp.array(array, dtype=wp.vec3d, device=DEVICE, copy=False)


def mat33s(array: NDArray[np.float64]) -> wp.array:
    """An array of 3 x 3 matrices; the last two axes are the matrix."""
    return wp.array(array, dtype=wp.mat33d, device=DEVICE, copy=False)


def launch(
    kernel: wp.Kernel, count: int | tuple[int, ...], inputs: list[Any], outputs: list[wp.array]
) -> None:
    """Run a kernel with ``count`` threads; none = nothing happens."""
    wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, device=DEVICE)


def known_devices() -> tuple[str, ...]:
    """Names of the devices that Warp sees: ``cpu``, and ``cuda:0`` and so on."""
    return tuple(str(device.alias) for device in wp.get_devices())


def use_device(name: str) -> None:
    """Make a device the usual one of this process, so that it takes no memory of another."""
    wp.set_device(name)
