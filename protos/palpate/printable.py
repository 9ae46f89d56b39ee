"""Texts of strangers on a terminal: control characters are shown, never sent."""

from __future__ import annotations

import unicodedata

_ACTING = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
# Categories of characters that act on a terminal or have no picture: controls (also C1), changes of
# the direction, lone surrogates, private and unassigned ones, separators of lines and paragraphs.


def printable(text: str, *, keep: str = "") -> str:
    r"""The text with every character that could act on a terminal written as ``\x1b``.

    Texts of files, of the bus and of other processes pass through here before they are printed.
    Characters of ``keep``, e.g. a line feed, stay.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        char if char in keep or unicodedata.category(char) not in _ACTING else _shown(char)
        for char in text
    )


def _shown(char: str) -> str:
    return char.encode("unicode_escape", "surrogatepass").decode("ascii")
