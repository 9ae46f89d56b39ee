"""The page shows the numbers that the last run of `make mutants` wrote."""

from __future__ import annotations

import json

from tests.mutation import page

REMEDY = "run: python -m tests.mutation.page"


def test_page_is_fresh() -> None:
    results = json.loads(page.RESULTS.read_text(encoding="utf-8"))
    reasons = json.loads(page.EQUIVALENT.read_text(encoding="utf-8"))
    assert results == page.judged(results, reasons), REMEDY
    text = page.PAGE.read_text(encoding="utf-8")
    assert text == page.with_table(text, results), REMEDY
