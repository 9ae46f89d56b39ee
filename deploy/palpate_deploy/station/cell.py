"""A text of a file or of the bus as it may stand in a table on a terminal."""

from __future__ import annotations

from rich.markup import escape

from palpate.printable import printable


def cell(text: str) -> str:
    """The text without control characters, and without a meaning as Rich's markup."""
    return escape(printable(text))
