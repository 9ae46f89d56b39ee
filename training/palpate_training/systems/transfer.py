"""Force on a finger that was never met: Gaussian processes on inputs that fingers share.

What differs from finger to finger is mostly a common mode: conductivity and temperature of the
fluid multiply the impedance of all electrodes, and the tare is never of the same moment. So inputs
are logarithms of the impedance over that at rest, less their mean over the electrodes, and beside
them their changes over half a second to twenty seconds, which no slow drift reaches. A Gaussian
process with a linear and a local part becomes a line where it extrapolates. Estimates are means
over a few such processes, none of them chosen alone.

From a finger's electrodes *without* forces comes more about the direction: a recording's mean and
spread, electrode by electrode, take the place of the other fingers'. From a few *labelled* presses
comes a correction that reaches as far as what was pressed, by the common mode, too, and of all that
lies some seconds before and after them, as baselines wander. Where these presses say that the
finger is far more or less sensitive than the others, its estimates are scaled first. From two
presses on, a line through the rows of all fingers, corrected in the same way, has a share. The
share is the one that estimates each of these presses best without itself.

Without a press nothing but the size of its signals tells how sensitive a finger is. Where they are
far larger than those of all other fingers, it is taken for more sensitive rather than for one that
is pressed harder than ever, and its signals are scaled down to theirs: what is learned goes no
further.

The magnitude's processes start from a line through the presses of a simulated population, mapped to
real fingers by what was learned on the others (``TwinLine``); what they learn is what that line
leaves. A network of the population helped in no way that was tried (training/LOG.md).

All constants were chosen on the two fingers of the LASA force calibration, in both directions, the
worse counting, and then frozen; those for fingers that are unlike the others or more sensitive, and
for the line, on simulated ones, too (training/LOG.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve
from scipy.signal import lfilter
from scipy.special import xlogy

from palpate.anatomy import ELECTRODE_MIRROR, ELECTRODE_POSITIONS
from palpate_training.datasets.features import at_an_end
from palpate_training.learning.baselines import AffineModel, ridge
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.twin_line import TwinLine
from palpate_training.systems.samples import counts_at, impedance_ohm

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.number]
Rows = npt.NDArray[np.integer]

ELECTRODES = len(ELECTRODE_POSITIONS)

SOURCE_ROWS = 450
"""Rows of each training finger, evenly spaced; each is used with its mirror image."""

NOISE = 0.1
"""Variance of the noise, over that of the forces: neighbouring rows err together."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """What one process sees of a row.

    Attributes:
        contexts_s: Times of the moving means [s]; what the present values differ by from each of
            them stands beside these values.
        weight: Of those differences, each in units of its spread.
        common: Share of the common mode that is kept.
    """

    contexts_s: tuple[float, ...]
    weight: float = 1.0
    common: float = 0.0


@dataclass(frozen=True, slots=True)
class Kernel:
    """``linear a.b / 19 + exp(-local |a - b|^2 / 19)``."""

    linear: float
    local: float

    def __call__(self, a: Floats, b: Floats) -> Floats:
        """Covariances of rows (N, D) and (M, D), shape (N, M)."""
        product = a @ b.T
        squares = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2.0 * product
        return np.asarray(
            self.linear / ELECTRODES * product + np.exp(-self.local / ELECTRODES * squares)
        )


_SHORT = Inputs((0.5, 5.0))
_KERNELS = (Kernel(1.5, 0.05), Kernel(1.5, 0.1))
MAGNITUDE = [(inputs, kernel) for inputs in (Inputs((0.5,)), _SHORT) for kernel in _KERNELS]
"""Processes whose mean length is the estimated magnitude."""

DIRECTION = [
    (inputs, kernel)
    for inputs in (_SHORT, Inputs((1.0, 10.0), weight=1.5), Inputs((0.5, 20.0)))
    for kernel in _KERNELS
]
"""Processes whose mean direction is the estimated direction."""

ALIGNED_DIRECTION = [
    (Inputs(contexts, common=common), Kernel(0.5, local))
    for contexts in ((0.5,), (0.5, 5.0))
    for common in (0.1, 0.3)
    for local in (0.05, 0.1)
]
"""The same on inputs that are aligned by the mean and the spread of each recording."""

CORRECTION_INPUTS = Inputs((0.5,), common=1.0)
CORRECTION = Kernel(0.0, 1.0)
CORRECTION_VARIANCE_N2 = 0.3
"""Of the error that labelled presses correct, near them."""

OFFSET_VARIANCE_N2 = 0.01
"""Of the error's share that is the same everywhere."""

WANDERING_N2, WANDERING_S = 0.1, 10.0
"""Variance of the error's share that wanders with the baselines, wherever the finger is pressed,
and the time over which it does [s]."""

PRESS_VARIANCE_N2 = 0.02
"""Of what the rows of one press share and those before and after it do not."""

ROW_VARIANCE_N2 = 0.01

SCALE_VARIANCE, LEAST_SCALE = 1.0, 0.05
"""Of the factor by which estimates are scaled where a finger is far more or less sensitive than the
others (its mean is 1), and the least that it may be. Not always: on fingers that are alike, slow
errors would pass for it."""

LIKELIER = 10.0
"""By how much more the log evidence of the labelled presses must be with such a factor."""

CLEARLY_BETTER = 0.8
"""Where several presses are labelled: share that it must leave, at most, of their error when each
is estimated without itself."""

LINE_WEIGHT, BELIEVED_PRESSES = 0.5, 4.0
"""What is believed of the line's weight before, and how many labelled presses tell as much."""

LINE_VALIDATION = 0.2
"""Share of each training finger's rows, its last ones, on which the line's penalty is chosen."""

ALIKE = 2.0
"""Mean impedance at rest of a finger over that of another one, up to which they are taken for
alike. Skin nearer to the core makes a finger more sensitive, and its impedance larger."""

SAME_USE = 1.5
"""Size of a finger's signals over that of the others, up to which it may well be as sensitive as
they and only be pressed harder. From its square on it is taken for more sensitive."""

SIZE_S = 10.0
"""Before anything is seen of a finger, its signals have the size of the others', as if it had been
seen for so long [s]."""

LEAST_SIGNAL = 1e-6
"""A logarithm that no electrode can tell from 0."""


@dataclass(frozen=True, slots=True)
class FingerRecording:
    """Rows of one finger in order of time.

    Attributes:
        electrodes: Raw counts, shape (N, 19).
        baseline: Untouched counts, shape (N, 19).
        segment: Number of the uninterrupted piece that each row belongs to, shape (N,).
        period_s: Time between two rows [s].
        force: [N], sensor frame, shape (N, 3).
    """

    electrodes: Counts
    baseline: Counts
    segment: Rows
    period_s: float
    force: Floats

    def logarithms(self) -> Floats:
        """Of the impedance over that at rest, the common mode included, shape (N, 19)."""
        return np.asarray(np.log(impedance_ohm(self.electrodes) / impedance_ohm(self.baseline)))

    def parts(self, inputs: Inputs) -> list[Floats]:
        """Present values, then their differences from moving means, each of shape (N, 19)."""
        values = self.logarithms()
        values -= (1.0 - inputs.common) * values.mean(axis=1, keepdims=True)
        means = (self._moving_mean(values, context_s) for context_s in inputs.contexts_s)
        return [values, *(values - mean for mean in means)]

    def signals(self) -> Floats:
        """Sizes of the present values without their common mode, shape (N,)."""
        sizes = np.linalg.norm(self.parts(Inputs(()))[0], axis=1)
        return np.asarray(np.maximum(sizes, LEAST_SIGNAL))

    def with_signals_divided(self, ratio: Floats) -> FingerRecording:
        """The same with its logarithms divided by ratios (N,)."""
        over_rest = np.exp(self.logarithms() / ratio[:, None])
        return replace(self, electrodes=counts_at(impedance_ohm(self.baseline) * over_rest))

    def rest_log(self) -> float:
        """Logarithm of the untouched impedance [ohm], mean over rows and electrodes that work."""
        works = ~at_an_end(self.baseline)
        rest = self.baseline[works] if works.any() else self.baseline
        return float(np.log(impedance_ohm(rest)).mean())

    def mirrored(self) -> FingerRecording:
        """What the finger would have read, had all been its mirror image."""
        return replace(
            self,
            electrodes=self.electrodes[:, ELECTRODE_MIRROR],
            baseline=self.baseline[:, ELECTRODE_MIRROR],
            force=self.force * MIRROR_AXES,
        )

    def _moving_mean(self, values: Floats, context_s: float) -> Floats:
        """Exponential moving mean within each segment, from the first row on."""
        share = -np.expm1(-self.period_s / context_s)
        mean = np.empty_like(values)
        starts = np.flatnonzero(np.diff(self.segment, prepend=self.segment[0] - 1))
        for rows in np.split(np.arange(len(values)), starts[1:]):
            piece = values[rows]
            mean[rows], _ = lfilter(
                [share], [1.0, share - 1.0], piece, axis=0, zi=(1.0 - share) * piece[:1]
            )
        return mean


@dataclass(frozen=True, slots=True)
class LabelledPresses:
    """Rows of the finger with a known force.

    Attributes:
        rows: Their numbers, shape (M,).
        press: Press of each, shape (M,).
    """

    rows: Rows
    press: Rows

    def where(self, kept: npt.NDArray[np.bool_]) -> LabelledPresses:
        """Some of the rows."""
        return LabelledPresses(self.rows[kept], self.press[kept])


@dataclass(frozen=True, slots=True)
class _Scale:
    """Centre and spread of each input, shape (D,)."""

    centre: Floats
    spread: Floats

    @classmethod
    def of(cls, recording: FingerRecording, inputs: Inputs) -> _Scale:
        """Those of a recording; electrodes that never change count with one."""
        rows = np.hstack(recording.parts(inputs))
        spread = rows.std(axis=0)
        return cls(rows.mean(axis=0), np.where(spread > 0.0, spread, 1.0))

    @classmethod
    def shared(cls, recordings: Sequence[FingerRecording], inputs: Inputs) -> _Scale:
        """No centre, and the mean spread of several recordings and their mirror images."""
        both = [*recordings, *(recording.mirrored() for recording in recordings)]
        spreads = [cls.of(recording, inputs).spread for recording in both]
        spread = np.sqrt(np.mean(np.square(spreads), axis=0))
        return cls(np.zeros(len(spread)), spread)

    def apply(self, recording: FingerRecording, inputs: Inputs, rows: Rows) -> Floats:
        """Inputs of some rows, shape (M, D)."""
        parts = np.hstack([part[rows] for part in recording.parts(inputs)])
        channels = parts.shape[1] // (1 + len(inputs.contexts_s))
        weight = np.repeat([1.0, *[inputs.weight] * len(inputs.contexts_s)], channels)
        return np.asarray(weight * (parts - self.centre) / self.spread)


def _mapped(line: TwinLine, sources: Sequence[FingerRecording]) -> TwinLine:
    """A line through the twin, mapped to real fingers: they differ from it alike."""
    guess = np.vstack([_said(line, source) for source in sources])
    return line.mapped(guess, np.vstack([source.force for source in sources]))


def _said(line: TwinLine, recording: FingerRecording) -> Floats:
    return line.force(recording.electrodes, recording.baseline)


class _Process:
    """One Gaussian process of the force, or of what a prior leaves of it."""

    def __init__(
        self,
        sources: Sequence[FingerRecording],
        inputs: Inputs,
        kernel: Kernel,
        *,
        prior: TwinLine | None = None,
        aligned: bool = False,
    ) -> None:
        self._inputs, self._kernel, self._aligned = inputs, kernel, aligned
        self._prior = prior
        self._scale = _Scale.shared(sources, inputs)
        rows, targets = [], []
        for source in sources:
            some = np.linspace(0, len(source.force), SOURCE_ROWS, endpoint=False).astype(int)
            some = np.unique(some)
            for one in (source, source.mirrored()):
                rows.append(self._scale_of(one).apply(one, inputs, some))
                known = 0.0 if prior is None else _said(prior, one)[some]
                targets.append(one.force[some] - known)
        self._rows = np.vstack(rows)
        force = np.vstack(targets)
        self._unit = force.std() or 1.0
        covariance = kernel(self._rows, self._rows)
        covariance[np.diag_indices(len(covariance))] += NOISE
        self._weight = cho_solve(cho_factor(covariance, lower=True), force / self._unit)

    def _scale_of(self, recording: FingerRecording) -> _Scale:
        return _Scale.of(recording, self._inputs) if self._aligned else self._scale

    def __call__(self, recording: FingerRecording) -> Floats:
        """Forces of all rows [N], shape (N, 3)."""
        everything = np.arange(len(recording.electrodes))
        rows = self._scale_of(recording).apply(recording, self._inputs, everything)
        parts = np.array_split(rows, max(1, len(rows) // 4000))
        learned = np.vstack([self._kernel(part, self._rows) @ self._weight for part in parts])
        known = 0.0 if self._prior is None else _said(self._prior, recording)
        return np.asarray(self._unit * learned + known)


@dataclass(frozen=True, slots=True)
class CorrectedForces:
    """Estimates of all rows of a recording after labelled presses.

    Attributes:
        force: [N], shape (N, 3).
        held_out: Estimates of the labelled rows, each without its own press, shape (M, 3).
    """

    force: Floats
    held_out: Floats


class ForceTransfer:
    """Estimates forces on fingers that are not among those it was fitted to."""

    def __init__(self, sources: Sequence[FingerRecording], line: TwinLine | None = None) -> None:
        """Fit to recordings of other fingers, with their forces.

        Args:
            sources: The recordings.
            line: Prior of the magnitude; None = none.
        """
        self._sources = sources
        self._scale = _Scale.shared(sources, CORRECTION_INPUTS)
        self._signals = [source.signals() for source in sources]
        prior = None if line is None else _mapped(line, sources)
        self._magnitude = [_Process(sources, *each, prior=prior) for each in MAGNITUDE]
        self._direction = [_Process(sources, *each) for each in DIRECTION]

    @cached_property
    def _aligned(self) -> list[_Process]:
        """Only needed where unlabelled electrodes may be used."""
        return [_Process(self._sources, *each, aligned=True) for each in ALIGNED_DIRECTION]

    def estimate(self, recording: FingerRecording, *, unlabelled: bool) -> Floats:
        """Forces [N], shape (N, 3); those of the recording are not looked at.

        Args:
            recording: Of the new finger.
            unlabelled: Whether mean and spread of all its electrodes may be used, later rows
                included; else a row's estimate follows from the tare and the rows before it.
        """
        ratio = self.signal_ratio(recording, whole=unlabelled)
        # 0 up to `SAME_USE`, 1 from its square on.
        share = np.clip(np.log(ratio) / np.log(SAME_USE) - 1.0, 0.0, 1.0)
        if share.any():
            recording = recording.with_signals_divided(ratio**share)
        direction = _mean_direction([process(recording) for process in self._direction])
        if unlabelled:
            direction += _mean_direction([process(recording) for process in self._aligned])
            direction = _unit(direction)
        lengths = [np.linalg.norm(process(recording), axis=1) for process in self._magnitude]
        return np.asarray(np.mean(lengths, axis=0)[:, None] * direction)

    def signal_ratio(self, recording: FingerRecording, *, whole: bool) -> Floats:
        """Size of a finger's signals over that of the training finger with the largest, (N,).

        The size is a geometric mean over the rows, each weighted by itself, so that it does not
        matter how long a finger is left untouched.

        Args:
            recording: Of the new finger.
            whole: Whether all rows tell it; else those up to each.
        """
        signals = recording.signals()
        weight, told = signals, xlogy(signals, signals)
        weight, told = (
            np.full(len(one), one.sum()) if whole else np.cumsum(one) for one in (weight, told)
        )
        rows = SIZE_S / recording.period_s
        ratios = []
        for known in self._signals:
            known_weight, known_told = known.mean(), xlogy(known, known).mean()
            size = (told + rows * known_told) / (weight + rows * known_weight)
            ratios.append(np.exp(size - known_told / known_weight))
        return np.asarray(np.min(ratios, axis=0))

    def impedance_ratio(self, recording: FingerRecording) -> float:
        """Untouched impedance over that of the training finger that is nearest in it."""
        apart = [recording.rest_log() - source.rest_log() for source in self._sources]
        return float(np.exp(min(apart, key=abs)))

    def mean_force(self) -> Floats:
        """Of the training fingers [N], shape (3,): all that is known of one that is unlike them.

        A finger that is far less sensitive shows its drift where others show forces, and one that
        is far more sensitive seems pressed hard all the time.
        """
        return np.asarray(np.vstack([source.force for source in self._sources]).mean(axis=0))

    def correct(
        self, recording: FingerRecording, estimate: Floats, labelled: LabelledPresses
    ) -> CorrectedForces:
        """Correct estimates by labelled presses of the same finger.

        Where these presses say that the finger is far more or less sensitive than the others, the
        estimates are scaled first. With several presses the line has its share.

        Args:
            recording: With the forces of the labelled rows; no others are looked at.
            estimate: Of all its rows [N], shape (N, 3).
            labelled: Which rows.
        """
        rows = self._scale.apply(recording, CORRECTION_INPUTS, np.arange(len(estimate)))
        process = _ErrorProcess(recording, rows, labelled)
        found = _scaled(process, estimate)
        if len(process.presses) == 1:
            return found  # nothing tells what the line is worth
        line = self._by_line(recording, process)
        weight = _line_weight(process, found, line)
        return CorrectedForces(
            (1.0 - weight) * found.force + weight * line.force,
            (1.0 - weight) * found.held_out + weight * line.held_out,
        )

    def _by_line(self, recording: FingerRecording, process: _ErrorProcess) -> CorrectedForces:
        """The same by a ridge regression that knows the labelled rows, corrected by them."""
        inputs = recording.logarithms()

        def estimate(known: _ErrorProcess) -> Floats:
            rows = known.labelled.rows
            line = line_through(self._line_rows, (inputs[rows], recording.force[rows]))
            return line.predict(inputs)

        return CorrectedForces(process.force(estimate(process)), process.without_each(estimate))

    @cached_property
    def _line_rows(self) -> list[tuple[Floats, Floats]]:
        """Inputs of the line and forces, of each training finger."""
        return [(source.logarithms(), source.force) for source in self._sources]


def _scaled(process: _ErrorProcess, estimate: Floats) -> CorrectedForces:
    """Scale estimates where presses say so, and correct them."""

    def scale(known: _ErrorProcess) -> Floats:
        return known.scale(estimate) * estimate

    held_out, scaled = process.held_out(estimate), scale(process)
    # Log evidences differ by the misfits alone: the covariance is the same.
    if 0.5 * (process.misfit(estimate) - process.misfit(scaled)) <= LIKELIER:
        return CorrectedForces(process.force(estimate), held_out)
    if len(process.presses) > 1:
        without = process.without_each(scale)
        error, before = (
            np.median(np.linalg.norm(process.known - each, axis=1)) for each in (without, held_out)
        )
        if error >= CLEARLY_BETTER * before:
            return CorrectedForces(process.force(estimate), held_out)
        held_out = without
    return CorrectedForces(process.force(scaled), held_out)


def line_through(
    others: Sequence[tuple[Floats, Floats]], known: tuple[Floats, Floats]
) -> AffineModel:
    """A ridge regression; labelled rows count as much as all others together.

    Args:
        others: Inputs (N, I) and forces (N, 3) of each training finger, in order of time.
        known: Those of the labelled rows; there may be none.
    """
    ends = [round(len(force) * (1.0 - LINE_VALIDATION)) for _, force in others]
    parts = [(x[:end], y[:end]) for (x, y), end in zip(others, ends, strict=True)]
    last = [(x[end:], y[end:]) for (x, y), end in zip(others, ends, strict=True)]
    times = max(1, sum(ends) // max(1, len(known[1])))
    parts.append((np.tile(known[0], (times, 1)), np.tile(known[1], (times, 1))))
    rows, last_rows = (
        [np.vstack(one) for one in zip(*some, strict=True)] for some in (parts, last)
    )
    return ridge(*rows, *last_rows)


def _line_weight(process: _ErrorProcess, found: CorrectedForces, line: CorrectedForces) -> float:
    """Share of the line that leaves the least squares of held-out errors, with what is believed."""
    apart = line.held_out - found.held_out
    size = float(np.mean(np.square(apart)))
    gain = float(np.mean(apart * (process.known - found.held_out)))
    presses = len(process.presses)
    told = presses * gain + BELIEVED_PRESSES * LINE_WEIGHT * size
    return float(np.clip(told / max((presses + BELIEVED_PRESSES) * size, 1e-12), 0.0, 1.0))


class _ErrorProcess:
    """A Gaussian process of the error of estimates, which is known at labelled rows.

    Estimates are of all rows of the recording, shape (N, 3); the labelled ones are M.

    Attributes:
        labelled: The labelled rows.
        presses: Numbers of the presses that they belong to.
        known: Their forces [N], shape (M, 3).
    """

    def __init__(
        self,
        recording: FingerRecording,
        rows: Floats,
        labelled: LabelledPresses,
        inverse: Floats | None = None,
    ) -> None:
        self._recording, self._rows, self.labelled = recording, rows, labelled
        self.presses, self.known = np.unique(labelled.press), recording.force[labelled.rows]
        if inverse is None:
            same = labelled.press[:, None] == labelled.press
            covariance = self._covariance(labelled.rows) + PRESS_VARIANCE_N2 * same
            covariance[np.diag_indices(len(same))] += ROW_VARIANCE_N2
            inverse = np.linalg.inv(covariance)
        self._inverse = inverse

    def misfit(self, estimate: Floats) -> float:
        """Squares of the labelled errors over their covariance; less is likelier."""
        error = self._error(estimate)
        return float(np.sum(error * (self._inverse @ error)))

    def force(self, estimate: Floats, some: Rows | None = None) -> Floats:
        """Corrected estimates [N] of some rows, shape (K, 3); None = of all."""
        some = np.arange(len(estimate)) if some is None else some
        weight = self._inverse @ self._error(estimate)
        parts = np.array_split(some, max(1, len(some) // 4000))
        change = [self._covariance(part) @ weight for part in parts]
        return np.asarray(estimate[some] + np.vstack(change))

    def held_out(self, estimate: Floats) -> Floats:
        """Corrected estimates of the labelled rows, each without its own press, shape (M, 3)."""
        held_out = self.known.astype(np.float64)
        weight = self._inverse @ self._error(estimate)
        # What is left of a press when it is left out follows from the inverse alone.
        for press in self.presses:
            own = self.labelled.press == press
            held_out[own] -= np.linalg.solve(self._inverse[np.ix_(own, own)], weight[own])
        return held_out

    def without_each(self, estimate: Callable[[_ErrorProcess], Floats]) -> Floats:
        """The same where estimates, too, follow from the other presses, shape (M, 3).

        Args:
            estimate: Makes them from the process of the other presses.
        """
        held_out = np.empty((len(self.labelled.rows), 3))
        for press in self.presses:
            own = self.labelled.press == press
            # The inverse without these rows follows from the whole one: M**2 steps, not M**3.
            shared = self._inverse[np.ix_(own, ~own)]
            less = shared.T @ np.linalg.solve(self._inverse[np.ix_(own, own)], shared)
            inverse = self._inverse[np.ix_(~own, ~own)] - less
            known = self.labelled.where(~own)
            others = _ErrorProcess(self._recording, self._rows, known, inverse)
            held_out[own] = others.force(estimate(others), self.labelled.rows[own])
        return held_out

    def scale(self, estimate: Floats) -> float:
        """The factor of the estimates that the labelled rows make likeliest, `LEAST_SCALE` or more.

        By generalised least squares with what is believed before: 1, with `SCALE_VARIANCE`.
        """
        known = estimate[self.labelled.rows]
        weighted = self._inverse @ known
        information = float(np.sum(known * weighted)) + 1.0 / SCALE_VARIANCE
        return max(LEAST_SCALE, 1.0 + float(np.sum(weighted * self._error(estimate))) / information)

    def _error(self, estimate: Floats) -> Floats:
        return np.asarray(self.known - estimate[self.labelled.rows])

    def _covariance(self, some: Rows) -> Floats:
        """Of the errors of some rows with those of the labelled ones, shape (N, M)."""
        recording, labelled = self._recording, self.labelled.rows
        place = CORRECTION_VARIANCE_N2 * CORRECTION(self._rows[some], self._rows[labelled])
        apart_s = recording.period_s * np.abs(some[:, None] - labelled)
        together = recording.segment[some][:, None] == recording.segment[labelled]
        moment = WANDERING_N2 * together * np.exp(-apart_s / WANDERING_S)
        return np.asarray(OFFSET_VARIANCE_N2 + place + moment)


def _mean_direction(forces: Sequence[Floats]) -> Floats:
    return _unit(np.sum([_unit(force) for force in forces], axis=0))


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
