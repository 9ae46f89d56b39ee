"""The model card of a bundle: what it estimates, what it learned from, how good it was.

Markdown, from the manifest alone, so a card never says what the bundle does not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from palpate.files.intervals import TERMS, Intervals
from palpate.files.manifest import Manifest
from palpate.messages import TrainingRange, ValueRange

TASK_WORDS = {
    "features": "Net force and place of contact, from the tared electrodes of one BioTac.",
    "field": "Fields on the skin, from the tared electrodes of one BioTac.",
    "synthesis": "Tared electrodes of one BioTac, from the displacement of the skin.",
}

OUTPUT_WORDS = {
    "electrodes": "counts less those of the tare",
    "tared_counts": "counts less those of the tare",
    "force": "net force on the finger",
    "contact_location": "centre of the indenter's tip, as the paper labels it",
    "centre_of_pressure": "where the net force goes through the deformed skin",
    "contact_normal": "mean direction of contact forces, out of the skin",
    "displacement": "of each node, from the pressurised, untouched state",
    "contact_force": "on each node; spread over its neighbours as the list below says",
    "coefficients": "of the displacement in the bundle's own basis",
}

_UNITS = {"_m": ("mm", 1e3), "_n": ("N", 1.0), "_rad": ("rad", 1.0), "_counts": ("counts", 1.0)}


def model_card(manifest: Manifest, digest: bytes) -> str:
    """A page for people about a bundle.

    Args:
        manifest: Of the bundle.
        digest: SHA-256 of the manifest's file, 32 bytes: what estimates carry.
    """
    threshold = manifest.contact_threshold_n
    facts = [
        ("task", f"`{manifest.task}`: {TASK_WORDS[manifest.task]}"),
        ("sensor", manifest.sensor_type),
        ("frame", "finger, as in docs/conventions.md; SI units"),
        ("digest", f"`{digest.hex()}`"),
        ("made", f"{manifest.created[:10]} with palpate {manifest.palpate_version}"),
        ("trained on", manifest.trained_on),
        (
            "made for",
            ", ".join(manifest.sensor_serials) or "no sensor in particular; its estimates say so",
        ),
        ("training data", f"content sha256 `{manifest.training_data_sha256}`"),
        ("ONNX operator set", str(manifest.opset)),
    ]
    if threshold:
        facts.append(("in contact", f"from an estimated force of {threshold:g} N"))
    tensors = [
        (
            side,
            f"`{tensor.name}`",
            " x ".join("any" if width < 0 else str(width) for width in tensor.shape),
            tensor.unit,
            _words_of(tensor.name),
        )
        for side, some in (("in", manifest.inputs), ("out", manifest.outputs))
        for tensor in some
    ]
    return "\n".join(
        [
            f"# {manifest.name} {manifest.version}",
            "",
            *_table(("", ""), facts),
            "",
            "## Inputs and outputs",
            "",
            *_table(("", "tensor", "shape", "unit", "what it is"), tensors),
            "",
            *(f"* {name}: {how}" for name, how in manifest.normalisation.items()),
            "",
            "## How good it was on rows that it was not trained on",
            "",
            "Rows of the data named above. On another finger, with another indenter or at another"
            " temperature it may be worse; estimates carry flags where the input is unlike the"
            " training rows.",
            "",
            *_table(("metric", "value", "unit"), map(_metric, sorted(manifest.metrics.items()))),
            "",
            "## How far its estimates may be off",
            "",
            *_bounds(manifest.intervals),
            "",
            "## Where it was trained",
            "",
            *_ranges(manifest.training_range),
            "",
        ]
    )


def _bounds(intervals: Intervals | None) -> list[str]:
    if intervals is None:
        return ["Not known: estimates give no bounds."]
    level = f"{intervals.level:.0%}"
    lines = [
        f"Each estimate has bounds of its error. They hold in {level} of the frames of a press, on"
        f" average over presses like those that they were learned from: {intervals.source}.",
        "",
    ]
    if not intervals.others:
        lines.append("For sensors that it was not made for it gives no bounds.")
    else:
        lines.append(
            "Bounds for sensors that it was not made for were learned from"
            f" {intervals.others_source}."
        )
    rows = [
        (f"`{one.name}`", one.unit, whose, ", ".join(f"{weight:.4g}" for weight in one.weights))
        for whose, some in (("its own", intervals.formulas), ("others", intervals.others))
        for one in some
    ]
    lines += ["", "A bound is the exponential of the weighted sum of its terms.", ""]
    return [*lines, *_table(("bound of", "unit", "sensors", f"weights of {_TERMS}"), rows)]


_TERMS = ", ".join(TERMS)


def _words_of(name: str) -> str:
    if name.endswith("_sd"):
        return f"standard deviation of `{name.removesuffix('_sd')}`"
    return OUTPUT_WORDS.get(name, "")


def _metric(item: tuple[str, float]) -> tuple[str, str, str]:
    name, value = item
    for ending, (unit, factor) in _UNITS.items():
        # A bin of forces stands behind the unit: nodal_all_m_above_8n.
        bare, _, rest = name.rpartition(ending)
        if bare and (not rest or rest in ("_below_2n", "_2_to_8n", "_above_8n")):
            return f"`{name}`", f"{factor * value:.4g}", unit
    return f"`{name}`", f"{value:.4g}", ""


def _ranges(known: TrainingRange | None) -> list[str]:
    if known is None:
        return ["Not known: the bundle is older than this part of the manifest."]
    lines = [f"{known.source}.", ""]
    rows = [
        (f"`{one.name}`", one.unit, _ends(one), f"{one.length_max:.4g}" if one.length_max else "-")
        for one in (*known.inputs, *known.outputs)
    ]
    lines += _table(("tensor", "unit", "smallest and largest of each value", "longest"), rows)
    if known.combinations:
        lines += ["", "It also knows which inputs occur together, and flags inputs that do not."]
    return lines


def _ends(values: ValueRange) -> str:
    if not values.low:
        return "-"
    return ", ".join(
        f"{low:.4g} to {high:.4g}" for low, high in zip(values.low, values.high, strict=True)
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [
        f"| {' | '.join(head)} |",
        f"|{'---|' * len(head)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]
