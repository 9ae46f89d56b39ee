"""Sparse direct solution of the symmetric tangent."""

from __future__ import annotations

import logging
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from palpate.errors import ConfigError, SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.sparse.fronts import FrontalFactor, FrontAssembly, UnsafePivotError

_log = logging.getLogger(__name__)

Indices = NDArray[np.integer[Any]]

SOLVERS = ("auto", "fronts", "fronts-double", "superlu")


class SparseFactor(Protocol):
    """Factor of a symmetric matrix with a fixed pattern (upper triangle in CSR)."""

    name: str

    def factorise(self, values: Floats) -> None:
        """Factorise the matrix with these values of its upper triangle.

        Raises:
            SimulationError: It is singular or not finite; there is then no factor.
        """

    def factorise_definite(self, values: Floats) -> bool:
        """Factorise it only if all its eigenvalues are clearly positive; returns whether they are.

        Cheaper than `factorise` and `negative` where they are not: it ends at the first sign of it.

        Raises:
            SimulationError: It is not finite; there is then no factor.
        """

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""

    @property
    def negative(self) -> int:
        """Negative eigenvalues of the last matrix: directions in which the body is unstable."""


def make_factor(
    indptr: Indices, indices: Indices, *, groups: Indices | None = None, solver: str = "auto"
) -> SparseFactor:
    """A solver for one pattern.

    Args:
        indptr: Upper triangle in CSR, every diagonal entry present.
        indices: Its columns, sorted.
        groups: Node of each unknown, (n,); None = each unknown is a node.
        solver: ``fronts`` works in single precision, and in double for matrices that need it;
            ``fronts-double`` always in double; ``superlu`` is SciPy's; ``auto`` = ``fronts``.

    Raises:
        ConfigError: The named solver is not known.
    """
    if solver not in SOLVERS:
        raise ConfigError(f"no solver {solver!r}", remedy=f"choose {', '.join(SOLVERS)}")
    if solver == "superlu":
        return SuperLu(indptr, indices)
    if groups is None:
        groups = np.arange(len(indptr) - 1)
    return Multifrontal(FrontAssembly(indptr, indices, groups), double=solver == "fronts-double")


class Multifrontal:
    """Multifrontal factor in single precision, and in double for matrices that need it.

    Single precision is faster, and its rounding errors only slow Newton's method down a little:
    the residual is always evaluated in double precision.
    """

    name = "fronts"

    def __init__(self, places: FrontAssembly, *, double: bool) -> None:
        self._places = places
        self._single = None if double else FrontalFactor(places, np.float32)
        self._double: FrontalFactor | None = None
        self._current: FrontalFactor | None = None

    def factorise(self, values: Floats) -> None:
        """See `SparseFactor`."""
        self._current = None
        check_finite(values)
        if self._single is not None:
            try:
                self._single.factorise(values)
            except UnsafePivotError:
                _log.debug(
                    "a pivot is lost in single precision; this matrix is factorised in double"
                )
            else:
                self._current = self._single
                return
        if self._double is None:
            self._double = FrontalFactor(self._places, np.float64)
        try:
            self._double.factorise(values)
        except UnsafePivotError as error:
            raise SimulationError(
                "the tangent is singular (a pivot vanishes)",
                remedy="hold the body, or use smaller increments",
            ) from error
        self._current = self._double

    def factorise_definite(self, values: Floats) -> bool:
        """See `SparseFactor`."""
        if self._single is None:
            return _is_definite(self, values)
        self._current = None
        check_finite(values)
        try:
            self._single.factorise(values)
        except UnsafePivotError:
            return False
        self._current = self._single
        return True

    def solve(self, right: Floats) -> Floats:
        """See `SparseFactor`."""
        if self._current is None:
            raise SimulationError("there is no factor to solve with", remedy="factorise first")
        return self._current.solve(np.asarray(right, np.float64))

    @property
    def negative(self) -> int:
        """See `SparseFactor`."""
        return 0 if self._current is None else self._current.negative

    @property
    def redone(self) -> int:
        """Number of fronts that the last factorisation repeated."""
        return 0 if self._current is None else self._current.redone

    @property
    def statistics(self) -> dict[str, float]:
        """Size of the factor: entries, operations [GFlop], memory [MiB] and number of fronts."""
        elimination = self._places.elimination
        shares = sum(len(front.border) ** 2 for front in elimination.fronts)
        width = 4.0 if self._current is self._single else 8.0
        return {
            "factor_entries": float(elimination.entries),
            "factor_gflop": elimination.flop / 1e9,
            "factor_mib": width * (elimination.entries + shares) / 2**20,
            "factor_fronts": float(len(elimination.fronts)),
        }


class SuperLu:
    """SciPy's SuperLU: unsymmetric, on one core; reference for tests of the fronts."""

    name = "superlu"

    def __init__(self, indptr: Indices, indices: Indices) -> None:
        size = len(indptr) - 1
        marks = np.arange(1, len(indices) + 1, dtype=np.float64)
        upper = sp.csr_matrix((marks, indices, indptr), shape=(size, size))
        full = (upper + sp.triu(upper, 1).T).tocsc()
        full.sort_indices()
        self._full = full
        self._gather = full.data.astype(np.int64) - 1
        self._factor: Any = None

    def factorise(self, values: Floats) -> None:
        """See `SparseFactor`."""
        self._factor = None
        check_finite(values)
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

    def factorise_definite(self, values: Floats) -> bool:
        """See `SparseFactor`."""
        return _is_definite(self, values)

    def solve(self, right: Floats) -> Floats:
        """See `SparseFactor`."""
        if self._factor is None:
            raise SimulationError("there is no factor to solve with", remedy="factorise first")
        return np.asarray(self._factor.solve(right))

    @property
    def negative(self) -> int:
        """See `SparseFactor`; exact while SuperLU keeps to the diagonal, which it prefers."""
        return 0 if self._factor is None else int((self._factor.U.diagonal() < 0.0).sum())


def _is_definite(factor: SparseFactor, values: Floats) -> bool:
    """By the whole factor: neither singular nor with a negative eigenvalue."""
    try:
        factor.factorise(values)
    except SimulationError:
        check_finite(values)
        return False
    return factor.negative == 0


def check_finite(values: Floats) -> None:
    """Raise SimulationError for entries that are not finite."""
    if not np.isfinite(values).all():
        raise SimulationError(
            "the tangent has entries that are not numbers", remedy="use smaller increments"
        )
