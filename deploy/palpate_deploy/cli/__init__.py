"""The commands of ``palpate``: their options and help texts."""

import os
import sys

WIDE = "250"
"""Columns of an output that is no terminal, e.g. a file: Rich would cut tables at 80."""


def main() -> None:
    """Entry point of ``palpate``."""
    if not (sys.stdout.isatty() or sys.stderr.isatty()):
        os.environ.setdefault("COLUMNS", WIDE)
    from palpate_deploy.cli.app import app

    app(prog_name="palpate")
