"""Columns of a table by name: numbers, truths, times and labels, with errors that say where."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from palpate.errors import DatasetError

if TYPE_CHECKING:
    import pyarrow as pa

Values = npt.NDArray[np.float64]

Columns = str | Annotated[list[str], Field(min_length=1)]
"""A column for each number, or one that holds all numbers of a row; a minus turns the sign."""

MISSING = np.iinfo(np.int64).min
"""Stands for a time, a label or a truth that a row lacks."""

_TIMES = "numbers, or timestamps with a date"


class TableColumns:
    """Columns of a table by name, with errors that say which and where."""

    def __init__(self, table: pa.Table, source: Path) -> None:
        self._table, self._source = table, source
        if not table.num_rows:
            raise DatasetError(f"{source} has no rows", remedy="give a table with rows")

    def numbers(self, names: Columns, width: int) -> Values:
        """Numbers, shape (N, width); NaN where one is missing."""
        if isinstance(names, str):
            return self._lists(names, width)
        if len(names) != width:
            raise DatasetError(
                f"{self._source}: {len(names)} columns are named from {names[0]!r} on, not {width}",
                remedy="name one column for each, in order",
            )
        return np.stack([self._column(name) for name in names], axis=1)

    def truths(self, name: str) -> npt.NDArray[np.int64]:
        """1 = true, 0 = false, or ``MISSING``, shape (N,)."""
        values = self._column(name, "true or false, or 1 or 0")
        lacking = np.isnan(values)
        wrong = np.flatnonzero((values != 0.0) & (values != 1.0) & ~lacking)
        if wrong.size:
            raise self._wrong(name, int(wrong[0]), f"{values[wrong[0]]:g}", "true or false")
        return np.where(lacking, MISSING, values == 1.0)

    def times(self, name: str, scale: float) -> npt.NDArray[np.int64]:
        """Times [ns] or ``MISSING``, shape (N,); whole numbers and timestamps are not rounded."""
        column = self._found(name)
        if "timestamp" in str(column.type):  # which says its unit itself
            known = self._cast(name, "timestamp[ns]", "times from 1678 to 2261", safe=True)
            column, scale = known.cast("int64"), 1.0
        whole = str(column.type).removeprefix("u").startswith("int")
        values = column.fill_null(0).to_numpy() if whole else self._column(name, _TIMES)
        lacking = column.is_null().to_numpy() if whole else np.isnan(values)
        most = (2**63 - 1) // int(scale)
        wrong = np.flatnonzero(~((values > -most) & (values < most)) & ~lacking)
        if wrong.size:
            raise self._wrong(name, int(wrong[0]), f"{values[wrong[0]]:g}", "a time")
        # A float would round times of today, as it has 53 bits.
        times = values.astype(np.int64) * int(scale) if whole else np.rint(values * scale)
        return np.where(lacking, MISSING, np.where(lacking, 0, times).astype(np.int64))

    def labels(
        self, name: str | None, else_: str, *, keep: bool = False
    ) -> tuple[tuple[str, ...], Any]:
        """Labels in order of appearance, and the number of each row's or ``MISSING``, (N,).

        ``keep``: If all are whole numbers, these.
        """
        if name is None:
            return (else_,), np.zeros(self._table.num_rows, np.int64)
        said = self._found(name).to_pylist()
        words = ["" if one is None or one != one else str(one).strip() for one in said]
        first: dict[str, Any] = {}
        for word, one in zip(words, said, strict=True):
            if word and first.setdefault(word, one) != one:
                raise DatasetError(
                    f"{self._source}: column {name!r} holds {first[word]!r} and {one!r}, which"
                    " differ in spaces only",
                    remedy="write one name for one thing, and other names for others",
                )
        numbers = {word: number for number, word in enumerate(dict.fromkeys(filter(None, words)))}
        if keep and all(re.fullmatch("0|[1-9][0-9]{0,8}", word) for word in numbers):  # int32
            numbers = {word: int(word) for word in numbers}
        return tuple(numbers), np.array([numbers.get(word, MISSING) for word in words], np.int64)

    def _found(self, name: str) -> Any:
        if name not in self._table.column_names:
            there = ", ".join(self._table.column_names[:40])
            raise DatasetError(
                f"{self._source} has no column {name!r}; it has: {there}",
                remedy="say which columns are what: --columns MAP.toml, see docs/data.md",
            )
        if self._table.column_names.count(name) > 1:
            raise DatasetError(
                f"{self._source} has several columns {name!r}", remedy="give each its own name"
            )
        return self._table.column(name)

    def _column(self, name: str, wanted: str = "numbers") -> Values:
        """Numbers of one column, shape (N,); a minus before its name turns the sign."""
        plain = self._plain(name)
        values = np.asarray(self._cast(plain, "float64", wanted).to_numpy(), np.float64)
        return values if plain == name else -values

    def _plain(self, name: str) -> str:
        """Name of the column, without a minus that turns its sign."""
        return name if name in self._table.column_names else name.removeprefix("-")

    def _cast(self, name: str, kind: str, wanted: str, *, safe: bool = False) -> Any:
        column = self._found(name)
        try:
            return column.cast(kind, safe=safe)
        except (ValueError, TypeError, NotImplementedError) as error:  # bases of Arrow's errors
            raise self._other_type(name, wanted) from error

    def _lists(self, name: str, width: int) -> Values:
        plain = self._plain(name)
        column = self._found(plain)
        if "list" not in str(column.type):
            return self.numbers([name], width)
        rows = column.to_pylist()
        for number, row in enumerate(rows):
            if row is None or len(row) != width:
                size = "nothing" if row is None else f"{len(row)} numbers"
                raise self._wrong(plain, number, size, f"{width} numbers")
        try:
            values = np.array(rows, np.float64)
        except (ValueError, TypeError) as error:  # of lists of text, or of lists
            raise self._other_type(plain, "lists of numbers") from error
        return values if plain == name else -values

    def _other_type(self, name: str, wanted: str) -> DatasetError:
        return DatasetError(
            f"{self._source}: column {name!r} holds {self._found(name).type}, not {wanted}",
            remedy=f"give {wanted}, or name another column",
        )

    def _wrong(self, name: str, row: int, found: str, wanted: str) -> DatasetError:
        return DatasetError(
            f"{self._source}: column {name!r} holds {found} in row {row}, not {wanted}",
            remedy="mend the table, or name another column",
        )
