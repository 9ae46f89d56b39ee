"""docs/simulation-store.md says what is so: its example runs, its tables are the schema."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pytest

from palpate_fem.result import IndentationResult
from palpate_fem.store.content import Outline, StoredFingertip
from palpate_fem.store.schema import CONVERGENCE
from palpate_fem.store.writer import StoreWriter

sample: Any = importlib.import_module("stored_sample")
indenter_outline: Callable[[str], Outline] = sample.indenter_outline
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory


@pytest.fixture(scope="module")
def page(root: Path) -> str:
    return (root / "docs" / "simulation-store.md").read_text(encoding="utf-8")


def test_example_runs(page: str) -> None:
    (example,) = re.findall(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    tip = sample_fingertip()
    given = {"tip": tip, "simulate": lambda name: sample_trajectory(tip)}
    exec(compile(example, "simulation-store.md", "exec"), given)


def _documented(page: str, heading: str) -> dict[str, tuple[str, str]]:
    """Kind and unit of each name in the table below a heading."""
    table = page.partition(f"### {heading}\n")[2].partition("\n#")[0]
    found = {}
    for row in re.findall(r"^\| (`.*)\|$", table, flags=re.MULTILINE):
        names, kinds, _, units, _ = (cell.strip() for cell in row.split(" |"))
        for at, name in enumerate(re.findall(r"`([^`]*)`", names)):
            # "float64, int32" of two names are one each; a single kind is of both. A unit may hold
            # a comma itself, so it is taken apart only where the kinds are.
            split = ", " in kinds
            kind = kinds.split(", ")[at] if split else kinds
            found[name] = kind, units.split(", ")[at] if split else units
    return found


def test_tables_are_the_schema(page: str, tmp_path: Path) -> None:
    tip = sample_fingertip(divisions=3)
    with StoreWriter(tmp_path / "s.sim", tip, outline=indenter_outline, stress=True) as store:
        store.write("a/b", sample_trajectory(tip, steps=2))
    head, body = tmp_path / "s.sim" / "fingertip.h5", tmp_path / "s.sim" / "trajectories/a/b.h5"
    for heading, path, group in (
        ("/fingertip", head, "fingertip"),
        ("/trajectories/ID", body, "trajectories/a/b"),
    ):
        documented = _documented(page, heading)
        with h5py.File(path) as file:
            written = file[group]
            names = {name + "/" * isinstance(written[name], h5py.Group) for name in written}
            assert names | set(written.attrs) == set(documented)
            for name, (kind, unit) in documented.items():
                dataset = written.get(name)
                if name in written.attrs or name.endswith("/") or kind == "compound":
                    assert kind == "attribute" or kind == "attributes" or kind == "compound", name
                    continue
                assert dataset.dtype == kind, name
                assert dataset.attrs["unit"].decode() == unit, name
            assert all(f"`{name}`" in page for name in CONVERGENCE.names or ())
            assert all(f"`{name}`" in page for name in file.attrs)
