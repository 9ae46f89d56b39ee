"""Sparse direct factorisation of the symmetric tangent; MKL where there is one, else SuperLU."""

from __future__ import annotations

import ctypes
import logging
import os
import sys
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from palpate.protos.errors import ConfigError, SimulationError

logger = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


class Factor(Protocol):
    """A matrix with a fixed pattern (upper triangle in CSR) that is factorised again and again."""

    name: str

    def factorise(self, values: Floats) -> None:
        """Factorise the matrix with these values of its upper triangle."""

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""


def make_factor(indptr: Ints, indices: Ints, *, solver: str = "auto") -> Factor:
    """The best solver of this machine.

    Args:
        indptr: Upper triangle in CSR, every diagonal entry present.
        indices: Its columns, sorted.
        solver: ``pardiso``, ``superlu`` or ``auto``.

    Raises:
        ConfigError: The named solver is not known or not installed.
    """
    if solver not in ("auto", "pardiso", "superlu"):
        raise ConfigError(f"no solver {solver!r}", remedy="choose auto, pardiso or superlu")
    if solver != "superlu":
        try:
            return Pardiso(indptr, indices)
        except (ImportError, OSError) as error:
            if solver == "pardiso":
                raise ConfigError(
                    f"MKL PARDISO cannot be loaded: {error}",
                    remedy="pip install pypardiso (x86-64 only), or choose superlu",
                ) from error
            logger.info("no MKL on this machine (%s); SuperLU is about five times slower", error)
    return SuperLu(indptr, indices)


class Pardiso:
    """MKL PARDISO, symmetric indefinite; symbolic analysis once."""

    name = "pardiso"

    def __init__(self, indptr: Ints, indices: Ints) -> None:
        if "torch" in sys.modules:
            # Torch brings an OpenMP and an MKL of its own; PARDISO then dies of a segmentation
            # fault (seen with torch 2.13 and MKL 2026.2, whichever threading layer is asked for).
            raise ImportError("torch is loaded in this process, and its MKL does not bear another")
        from pypardiso import PyPardisoSolver

        # pypardiso finds and declares the library; its own call shifts all indices every time,
        # which costs a fifth of a solve, so the call is made here.
        self._library = PyPardisoSolver(mtype=-2)
        # It searches the whole environment for MKL each time, 0.3 s, unless this names it.
        os.environ.setdefault("PYPARDISO_MKL_RT", self._library.libmkl._name)
        self._indptr = np.ascontiguousarray(indptr, np.int32)
        self._indices = np.ascontiguousarray(indices, np.int32)
        self._values = np.zeros(len(indices))
        set_option = self._library.iparm.__setitem__  # numbered from 0; MKL's manual from 1
        set_option(0, 1)  # no defaults
        set_option(1, 2)  # nested dissection
        set_option(9, 13)  # pivots below 1e-13 are replaced, and counted
        set_option(17, -1)  # count the factor's entries
        set_option(18, -1)  # and the operations of the factorisation
        set_option(20, 1)  # Bunch-Kaufman pivots
        set_option(23, 10)  # two-level factorisation: 0.11 instead of 0.15 s at 30,000 unknowns
        set_option(34, 1)  # indices from zero
        self._analysed = False
        self._factorised = False

    def factorise(self, values: Floats) -> None:
        """See `Factor`; singular or non-finite matrices raise SimulationError."""
        if not np.isfinite(values).all():
            raise SimulationError(
                "the tangent has entries that are not numbers", remedy="use smaller increments"
            )
        self._values[:] = values
        self._library.iparm[13] = 0  # vanished pivots; MKL adds to it
        self._call(22 if self._analysed else 12, np.zeros((1, len(self._indptr) - 1)))
        self._analysed = True
        self._factorised = not self._library.iparm[13]
        if not self._factorised:
            raise SimulationError(
                f"the tangent is singular ({self._library.iparm[13]} pivots vanish)",
                remedy="hold the body, or use smaller increments",
            )

    def solve(self, right: Floats) -> Floats:
        """See `Factor`."""
        if not self._factorised:
            raise SimulationError("there is no factor to solve with", remedy="factorise first")
        columns = np.ascontiguousarray(np.atleast_2d(right.T))  # MKL wants column after column
        answer = self._call(33, columns)
        return answer[0] if right.ndim == 1 else answer.T

    @property
    def statistics(self) -> dict[str, float]:
        """Entries of the factor, its operations [GFlop], and MKL's memory at the peak [MiB]."""
        iparm = self._library.iparm
        return {
            "factor_entries": float(iparm[17]),
            "factor_gflop": float(iparm[18]) / 1e3,
            "factor_peak_mib": max(float(iparm[14]), float(iparm[15]) + float(iparm[16])) / 1024,
        }

    def _call(self, phase: int, right: Floats) -> Floats:
        library, answer = self._library, np.zeros_like(right)
        error = ctypes.c_int32(0)

        def integer(value: int) -> object:
            return ctypes.byref(ctypes.c_int32(value))

        def pointer(array: NDArray[np.generic], kind: type) -> object:
            return array.ctypes.data_as(ctypes.POINTER(kind))

        library._mkl_pardiso(
            pointer(library.pt, library._pt_type[0]),
            integer(1),
            integer(1),
            integer(-2),
            integer(phase),
            integer(len(self._indptr) - 1),
            pointer(self._values, ctypes.c_double),
            pointer(self._indptr, ctypes.c_int32),
            pointer(self._indices, ctypes.c_int32),
            pointer(library.perm, ctypes.c_int32),
            integer(len(right)),
            pointer(library.iparm, ctypes.c_int32),
            integer(0),
            pointer(right, ctypes.c_double),
            pointer(answer, ctypes.c_double),
            ctypes.byref(error),
        )
        if error.value:
            raise SimulationError(
                f"MKL PARDISO failed with code {error.value} in phase {phase}",
                remedy="use smaller increments; -2 means out of memory",
            )
        return answer

    def __del__(self) -> None:
        # MKL holds the factor outside Python's memory; without this each Fingertip leaks 100 MB.
        if getattr(self, "_analysed", False) and not sys.is_finalizing():
            self._analysed = False
            self._call(-1, np.zeros((1, len(self._indptr) - 1)))


class SuperLu:
    """SciPy's SuperLU: everywhere, without symmetry, on one core."""

    name = "superlu"

    def __init__(self, indptr: Ints, indices: Ints) -> None:
        size = len(indptr) - 1
        marks = np.arange(1, len(indices) + 1, dtype=np.float64)
        upper = sp.csr_matrix((marks, indices, indptr), shape=(size, size))
        full = (upper + sp.triu(upper, 1).T).tocsc()
        full.sort_indices()
        self._full = full
        self._gather = full.data.astype(np.int64) - 1
        self._factor: object = None

    def factorise(self, values: Floats) -> None:
        """See `Factor`."""
        if not np.isfinite(values).all():
            raise SimulationError(
                "the tangent has entries that are not numbers", remedy="use smaller increments"
            )
        self._full.data = values[self._gather]
        try:
            self._factor = splu(
                self._full,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.01,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise SimulationError(
                f"SuperLU cannot factorise the tangent: {error}", remedy="use smaller increments"
            ) from error

    def solve(self, right: Floats) -> Floats:
        """See `Factor`."""
        return np.asarray(self._factor.solve(right))  # type: ignore[attr-defined]
