"""The documentation site: ``make site`` builds the project's Markdown into build/site.

Pages are the Markdown files of the repository, which read as well on a code host; nothing is
written for the site alone but the lists below and the reference of the Python packages (``api``). A
page that no list names appears under its folder, so a new one needs no entry here.
Why it is built so: docs/adr/0032-documentation-site.md.
"""

from __future__ import annotations

import functools
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sphinx.addnodes import toctree

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / room) for room in ("protos", "fem", "training")]

project = "palpate"
author = "the palpate authors"
copyright = "the palpate authors, Apache-2.0"
html_title = "palpate"
language = "en"
root_doc = "README"
include_patterns = ["*.md", "*/README.md", "training/LOG.md", "docs/**.md", "docs/site/api/*.rst"]
include_patterns += ["deploy/firmware/bridge/README.md", "tests/*/README.md"]
exclude_patterns = [".*", "build", "dist", "runs", "*.egg-info", "docs/changelog.d/*.*.md"]
exclude_patterns += ["node_modules"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 6  # those of a code host, so that links with # work in both places
myst_enable_extensions = ["dollarmath"]
default_role = "code"  # in docstrings, as in Markdown
suppress_warnings = ["myst.header"]  # some pages begin a list of sections below a picture

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring, napoleon_numpy_docstring = True, False

html_theme = "sphinx_book_theme"
html_theme_options = {
    "show_navbar_depth": 1,
    "use_download_button": False,
    "use_fullscreen_button": False,
    "home_page_in_toc": True,
    "navbar_persistent": [],
}
html_show_sourcelink = False
html_copy_source = False

SECTIONS = {
    "Start": ["docs/quick-start", "docs/install", "docs/first-biotac"],
    "Guides": ["docs/guides/*"],
    "Concepts": [
        "docs/concepts/*",
        "docs/conventions",
        "docs/tare-and-health",
        "docs/time",
        "docs/comparison",
    ],
    "Experiment and models": [
        "docs/twin",
        "docs/testbed",
        "docs/data",
        "docs/models",
        "docs/simulation-store",
    ],
    "Operate": [
        "docs/operations",
        "docs/failures",
        "docs/security",
        "docs/fleet",
        "docs/devices/README",
        "docs/ros",
    ],
    "Reference": ["docs/site/api/*", "docs/messages", "docs/asyncapi", "docs/examples/README"],
    "Results": ["docs/results/*"],
    "More": ["docs/*"],
    "The code": ["docs/house", "*/README", "CONTRIBUTING", "docs/README"],
}
"""Captions of the navigation, and below each its pages in order; a pattern takes those that no list
names, and a page that another branch has not written yet is left out."""

BELOW = {
    "docs/devices/README": ["docs/devices/*"],
    "docs/README": ["docs/adr/*", "docs/changelog.d/README", "CHANGELOG"],
    "docs/results/twin": ["docs/results/twin/*"],
    "docs/results/study": ["docs/results/study/*/report"],
    "docs/results/force-real": ["docs/results/as-stored/*"],
    "deploy/README": ["deploy/firmware/bridge/README"],
    "training/README": ["training/LOG"],
    "CONTRIBUTING": ["tests/*/README"],
}
"""Pages that stand below another one in the navigation."""


def listed(patterns: list[str], pages: set[str], named: set[str]) -> list[str]:
    """Pages that the patterns mean, in order; a pattern leaves out those ``named`` elsewhere."""
    found: list[str] = []
    for pattern in patterns:
        if "*" not in pattern:
            found += [pattern] if pattern in pages else []
        else:
            regex = re.compile(re.escape(pattern).replace(r"\*", "[^/]*"))
            found += sorted(page for page in pages - named if regex.fullmatch(page))
    return found


def _add_navigation(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the lists of pages to the first page, and to those that have pages below them."""
    lists = SECTIONS if page == root_doc else {"": BELOW[page]} if page in BELOW else {}
    every = [*SECTIONS.values(), *BELOW.values()]
    named = {name for patterns in every for name in patterns if "*" not in name}
    for caption, patterns in lists.items():
        pages = listed(patterns, app.env.found_docs - {root_doc}, named)
        lines = [":hidden:", *([f":caption: {caption}"] if caption else []), ""]
        lines += [f"/{name}" for name in pages]
        source[0] += "\n\n```{toctree}\n" + "\n".join(lines) + "\n```\n"


def _list_titles(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object
) -> None:
    """Spare each page a copy of all sections of all pages: its navigation shows titles alone."""
    navigation = context["toctree"]

    def of_titles(**options: Any) -> Any:
        whole = app.env.tocs
        if options.get("titles_only"):
            app.env.tocs = _without_sections(app.env)
        try:
            return navigation(**options)
        finally:
            app.env.tocs = whole

    context["toctree"] = of_titles


@functools.cache
def _without_sections(env: BuildEnvironment) -> dict[str, Any]:
    """Contents of each page as Sphinx leaves them of its copies: the title, and pages below it."""
    found = {page: contents.deepcopy() for page, contents in env.tocs.items()}
    for contents in found.values():
        for entry in contents:
            if len(entry) > 1:
                if below := list(entry.findall(toctree)):
                    entry[1][:] = below
                else:
                    entry.pop(1)
    return found


def _keep_colons(
    app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]
) -> None:
    """Keep napoleon from taking what stands before a constant's first colon for its type."""
    if what in {"data", "attribute", "property"}:
        lines[:0] = ["..", ""]  # an empty comment


def _first_page(app: Sphinx, failure: Exception | None) -> None:
    """A site begins at index.html."""
    if failure is None:
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html">\n'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.connect("source-read", _add_navigation)
    app.connect("html-page-context", _list_titles)
    app.connect("autodoc-process-docstring", _keep_colons, priority=100)
    app.connect("build-finished", _first_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
