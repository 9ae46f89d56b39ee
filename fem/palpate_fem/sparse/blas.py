"""BLAS and LAPACK routines on given memory, without the interpreter lock.

SciPy's own wrappers hold the lock while they run. The same routines are called here by the
addresses that ``scipy.linalg.cython_blas`` publishes for compiled code.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack
from threadpoolctl import ThreadpoolController

Array = NDArray[Any]

_LIBRARIES = ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep BLAS, NumPy's too, on the calling thread.

    Its own threads would compete with the two that work on the halves of the tree, and starting
    them takes longer than our short vectors do.
    """
    with _LIBRARIES.limit(limits=1, user_api="blas"):
        yield


_get_name = ctypes.pythonapi.PyCapsule_GetName
_get_name.restype, _get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
_get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_get_pointer.restype, _get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]


def _routine(module: Any, name: str, arguments: int) -> Callable[..., None]:
    capsule = module.__pyx_capi__[name]
    address = _get_pointer(capsule, _get_name(capsule))
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(address)


_LETTER = {np.dtype(np.float32): "s", np.dtype(np.float64): "d"}
_ROUTINES = {
    letter + name: _routine(module, letter + name, arguments)
    for letter in "sd"
    for module, name, arguments in (
        (cython_lapack, "potrf", 5),
        (cython_blas, "trsm", 11),
        (cython_blas, "syrk", 10),
        (cython_blas, "trsv", 8),
        (cython_blas, "gemv", 11),
    )
}


class BoundRoutine:
    """A routine with its arguments, prepared to be called many times.

    Args:
        name: Without the letter of the precision.
        kind: Precision.
        arguments: Letters as ``str``, sizes as ``int``, factors as ``float``, arrays by address.
    """

    def __init__(self, name: str, kind: np.dtype[Any], *arguments: str | int | float | Array):
        real = ctypes.c_float if kind == np.float32 else ctypes.c_double
        self._kept: list[Any] = []  # what the addresses point to
        addresses = []
        for argument in arguments:
            if isinstance(argument, np.ndarray):
                self._kept.append(argument)
                addresses.append(argument.ctypes.data)
                continue
            value: Any
            if isinstance(argument, str):
                value = ctypes.c_char(argument.encode())
            elif isinstance(argument, int):
                value = ctypes.c_int(argument)
            else:
                value = real(argument)
            self._kept.append(value)
            addresses.append(ctypes.addressof(value))
        self._addresses = tuple(addresses)
        self._routine = _ROUTINES[_LETTER[kind] + name]

    def __call__(self) -> None:
        """Run it."""
        self._routine(*self._addresses)


class Cholesky:
    """Cholesky factorisation of a matrix, in place: its lower factor."""

    def __init__(self, matrix: Array) -> None:
        self._info = np.zeros(1, np.int32)
        size = max(1, len(matrix))
        self._call = BoundRoutine("potrf", matrix.dtype, "L", len(matrix), matrix, size, self._info)

    def __call__(self) -> bool:
        """Run it; returns whether the matrix was positive definite."""
        self._call()
        return not self._info[0]


def solve_right(lower: Array, block: Array) -> BoundRoutine:
    """``block <- block L^-T``."""
    rows, size = block.shape
    return BoundRoutine(
        "trsm", block.dtype, "R", "L", "T", "N", rows, size, 1.0, lower, max(1, size), block,
        max(1, rows),
    )  # fmt: skip


def subtract_square(block: Array, target: Array) -> BoundRoutine:
    """``target <- target - block block^T``, its lower triangle."""
    rows, size = block.shape
    return BoundRoutine(
        "syrk", block.dtype, "L", "N", rows, size, -1.0, block, max(1, rows), 1.0, target,
        max(1, rows),
    )  # fmt: skip


def solve_left(lower: Array, vector: Array, *, transposed: bool) -> BoundRoutine:
    """``vector <- L^-1 vector``, or with its transpose."""
    size = len(lower)
    letter = "T" if transposed else "N"
    return BoundRoutine("trsv", lower.dtype, "L", letter, "N", size, lower, max(1, size), vector, 1)


def multiply(
    block: Array, vector: Array, factor: float, keep: float, target: Array, *, transposed: bool
) -> BoundRoutine:
    """``target <- keep * target + factor * block vector``, or with its transpose."""
    rows, size = block.shape
    letter = "T" if transposed else "N"
    return BoundRoutine(
        "gemv", block.dtype, letter, rows, size, factor, block, max(1, rows), vector, 1, keep,
        target, 1,
    )  # fmt: skip
