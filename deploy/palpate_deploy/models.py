"""``palpate model``: bundles that are there."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from palpate.errors import PalpateError
from palpate.files.bundle import read_bundle
from palpate_services.repository import PACKAGED, available, resolve
from palpate_services.runtime import load

TELLING_METRICS = (
    "force_magnitude_n_median",
    "force_angle_rad_median",
    "location_distance_m_median",
)
"""What a person wants to see of a bundle; the rest is in --json and in its manifest."""


def list_models(*, as_json: bool) -> None:
    """Print every bundle that comes with this palpate, a broken one with its error."""
    rows: list[dict[str, Any]] = []
    for name in available():
        try:
            bundle = read_bundle(resolve(name))
        except PalpateError as error:
            rows.append({"bundle": name, "error": str(error)})
            continue
        manifest = bundle.manifest
        rows.append(
            {
                "bundle": name,
                "task": manifest.task,
                "sha256": bundle.sha256.hex(),
                "trained_on": manifest.trained_on,
                "metrics": dict(manifest.metrics),
            }
        )
    if as_json:
        print(json.dumps({"repository": str(PACKAGED), "bundles": rows}, indent=2))
        return
    table = Table(title=str(PACKAGED), title_justify="left")
    for column in ("bundle", "task", "sha256", "trained on", "metrics"):
        table.add_column(column, overflow="fold")
    for row in rows:
        if "error" in row:
            table.add_row(str(row["bundle"]), "[red]broken[/]", "", escape(str(row["error"])), "")
            continue
        table.add_row(
            str(row["bundle"]),
            str(row["task"]),
            str(row["sha256"])[:12],
            escape(str(row["trained_on"])),
            "\n".join(
                f"{key} {value:.4g}"
                for key, value in row["metrics"].items()
                if key in TELLING_METRICS
            ),
        )
    Console().print(table)


def verify_model(name: str) -> None:
    """Check a bundle as the service does before it serves it, and say what it is.

    Raises:
        ConfigError: There is no such bundle.
        BundleError: It breaks its contract.
        MissingExtraError: ONNX Runtime is not installed.
    """
    bundle = read_bundle(resolve(name))
    load(bundle, bundle.manifest.task)
    manifest = bundle.manifest
    rows = next(iter(bundle.golden.values())).shape[0]
    print(f"ok  {manifest.name}:{manifest.version}  task {manifest.task}  {bundle.folder}")
    print(f"    digest {bundle.sha256.hex()}")
    print(f"    {rows} golden rows reproduced; trained on {manifest.trained_on}")
