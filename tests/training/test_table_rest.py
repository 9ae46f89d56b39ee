"""Untouched counts of a table's first rows: taken only where nothing touches in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.features import FeatureDataset
from palpate_training.datasets.tables import ColumnMap, dataset_of

Rows = dict[str, np.ndarray]

COUNT = 5
COLUMNS = ColumnMap(electrodes="skin", force="force", in_contact="touches", rest_rows=COUNT)


def read(change: Callable[[Rows], None], columns: ColumnMap = COLUMNS) -> FeatureDataset:
    """40 rows, pressed with 3 N from the eleventh on, as somebody else changed them."""
    pressed = np.arange(40) >= 10
    rows = {
        "skin": np.where(pressed[:, None], 1800, 2000 + np.arange(19)),
        "force": np.outer(pressed, [0.0, 0.0, -3.0]),
        "touches": pressed,
    }
    change(rows)
    table = pa.table({name: pa.array(list(values)) for name, values in rows.items()})
    return dataset_of(table, columns, source=Path("lab.parquet"))


def test_a_force_sensor_that_was_not_zeroed_is_no_touch() -> None:
    def offset(rows: Rows) -> None:
        rows["force"] += [0.0, 2.0, 0.3]

    np.testing.assert_array_equal(read(offset).baseline[0], 2000 + np.arange(19))


def zero(rows: Rows) -> None:
    rows["skin"][:COUNT] = 0


def press_first(rows: Rows) -> None:
    rows["force"][:COUNT] = [0.0, 0.0, -5.0]
    rows["skin"][:COUNT] -= 1000


def press_one(rows: Rows) -> None:
    rows["force"][3] = [0.0, 1.0, 0.0]


def touch_one(rows: Rows) -> None:
    rows["touches"][3] = True


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (zero, "rest of E1 is 0 in row 0"),
        (press_first, r"row 0 is one of the 5 untouched ones.*something touches in it \(5 N\)"),
        (press_one, r"row 3 is one of the 5 untouched ones.*\(1 N\)"),
        (touch_one, r"row 3 is one of the 5 untouched ones.*\(0 N\)"),
    ],
)
def test_a_rest_that_is_touched_or_of_no_biotac_is_refused(
    change: Callable[[Rows], None], says: str
) -> None:
    with pytest.raises(DatasetError, match=says):
        read(change)
