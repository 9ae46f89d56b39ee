"""Draw the house from its imports: docs/pictures/house.svg (``make docs``).

``python docs/make_house.py``          writes the picture
``python docs/make_house.py --check``  exits 1 if the committed picture is not what it would draw

A box is a folder or a top-level module of a room; an arrow says "imports". Of the arrows inside a
room only those are drawn that no longer path implies.
"""

from __future__ import annotations

import ast
import runpy
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "pictures" / "house.svg"
ROOMS = {
    "deploy": "palpate_deploy",
    "gateway": "palpate_gateway",
    "services": "palpate_services",
    "fem": "palpate_fem",
    "training": "palpate_training",
    "protos": "palpate",
}
ROWS = (("deploy",), ("gateway", "services", "fem", "training"), ("protos",))
"""Rooms of a row never import one another."""

Graph = dict[str, set[str]]


def product_modules(folder: Path = ROOT) -> dict[str, Path]:
    """Name -> file of every module of the rooms below ``folder`` that is written by hand."""
    found = {}
    for room, package in ROOMS.items():
        for path in sorted((folder / room / package).rglob("*.py")):
            if not path.stem.endswith("_pb2"):
                parts = path.relative_to(folder / room).with_suffix("").parts
                found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def import_graph(modules: Mapping[str, Path]) -> Graph:
    """Module -> modules of ours that it imports anywhere, also inside functions."""
    graph: Graph = {}
    for name, path in modules.items():
        targets = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.module, f"{path}: relative import"
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    targets.add(inner if inner in modules else node.module)
        graph[name] = {target for target in targets if target in modules and target != name}
    return graph


def _box_of(module: str) -> str | None:
    """The box that a module is drawn in: the first part of its name below the room's package."""
    parts = module.split(".")
    if len(parts) == 1 or parts[:2] == ["palpate", "v1"]:
        return None
    return ".".join(parts[:2])


def box_graph(graph: Graph) -> Graph:
    """Imports between boxes, those inside a box left out."""
    boxes: Graph = defaultdict(set)
    for module, targets in graph.items():
        source = _box_of(module)
        if source is None:
            continue
        boxes[source] |= {box for target in targets if (box := _box_of(target))} - {source}
    return dict(sorted(boxes.items()))


def _levels(boxes: Iterable[str], graph: Graph) -> dict[str, int]:
    """Box -> row in its room; 0 imports nothing of the room.

    Raises:
        graphlib.CycleError: Boxes import one another in a circle.
    """
    inside = {box: graph[box] & set(boxes) for box in boxes}
    levels: dict[str, int] = {}
    for box in TopologicalSorter(inside).static_order():
        levels[box] = 1 + max((levels[target] for target in inside[box]), default=-1)
    return levels


def _not_implied(boxes: Iterable[str], graph: Graph) -> list[tuple[str, str]]:
    """Arrows inside a room without those that a longer path already says."""
    inside = {box: graph[box] & set(boxes) for box in boxes}

    def reaches(start: str, end: str, *, without: str) -> bool:
        seen, todo = {start}, [start]
        while todo:
            node = todo.pop()
            for target in inside[node]:
                if node == start and target == without:
                    continue
                if target == end:
                    return True
                if target not in seen:
                    seen.add(target)
                    todo.append(target)
        return False

    return [
        (source, target)
        for source in sorted(inside)
        for target in sorted(inside[source])
        if not reaches(source, target, without=target)
    ]


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Where something is drawn [px]."""

    x: float
    y: float
    width: float
    height: float


BOX_H, GAP_X, GAP_Y, PAD, TITLE, LETTER = 26, 10, 24, 14, 26, 7.3
WIDTH = 1500
COLOURS = {
    "deploy": "#f3e3c3", "gateway": "#d8e8d0", "services": "#d5e3f0", "fem": "#efd9d9",
    "training": "#e4dcf0", "protos": "#e6e6e6",
}  # fmt: skip


def _rows_of(boxes: list[str], levels: Mapping[str, int], width: float) -> list[list[str]]:
    """Boxes in rows from the highest level down; a row that is too wide is broken."""
    rows: list[list[str]] = []
    for level in sorted(set(levels.values()), reverse=True):
        row: list[str] = []
        used = 0.0
        for box in [box for box in boxes if levels[box] == level]:
            need = _box_width(box) + GAP_X
            if row and used + need > width:
                rows.append(row)
                row, used = [], 0.0
            row.append(box)
            used += need
        rows.append(row)
    return rows


def _box_width(box: str) -> float:
    return LETTER * len(box.split(".")[1]) + 18


def draw(boxes: Graph, crossing: Iterable[tuple[str, str]]) -> str:
    """The picture as SVG.

    Args:
        boxes: Imports between boxes.
        crossing: Pairs of rooms of which the first imports from the second.
    """
    places: dict[str, Rectangle] = {}
    rooms: dict[str, Rectangle] = {}
    y = 20.0
    for row in ROWS:
        width = (WIDTH - 40 - 24 * (len(row) - 1)) / len(row)
        bottom = y
        for column, room in enumerate(row):
            x = 20 + column * (width + 24)
            mine = [box for box in boxes if box.split(".")[0] == ROOMS[room]]
            level = _levels(mine, boxes)
            line = y + TITLE + PAD
            for names in _rows_of(mine, level, width - 2 * PAD):
                total = sum(_box_width(name) + GAP_X for name in names) - GAP_X
                left = x + (width - total) / 2
                for name in names:
                    places[name] = Rectangle(left, line, _box_width(name), BOX_H)
                    left += _box_width(name) + GAP_X
                line += BOX_H + GAP_Y
            rooms[room] = Rectangle(x, y, width, line - y)
            bottom = max(bottom, line)
        for room in row:
            old = rooms[room]
            rooms[room] = Rectangle(old.x, old.y, old.width, bottom - y)
        y = bottom + 44
    height = y - 24
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}"'
        ' font-family="monospace" font-size="12">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7"'
        ' markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" fill="#555"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{height:.0f}" fill="white"/>',
    ]
    for room, at in rooms.items():
        out.append(_rectangle(at, COLOURS[room], 8))
        out.append(
            f'<text x="{at.x + PAD:.0f}" y="{at.y + 20:.0f}" font-size="15" font-weight="bold">'
            f"{room}/{ROOMS[room]}</text>"
        )
    for room in ROOMS:
        mine = [box for box in boxes if box.split(".")[0] == ROOMS[room]]
        for source, target in _not_implied(mine, boxes):
            out.append(_arrow(places[source], places[target]))
    for source, target in sorted(crossing):
        if (source, target) != ("deploy", "protos"):  # it imports from all; seven arrows hide more
            out.append(_crossing(rooms[source], rooms[target]))
    for name, at in places.items():
        out.append(_rectangle(at, "white", 4))
        out.append(
            f'<text x="{at.x + at.width / 2:.1f}" y="{at.y + 17:.0f}" text-anchor="middle">'
            f"{name.split('.')[1]}</text>"
        )
    return "\n".join([*out, "</svg>", ""])


def _rectangle(at: Rectangle, colour: str, radius: int) -> str:
    return (
        f'<rect x="{at.x:.1f}" y="{at.y:.1f}" width="{at.width:.1f}" height="{at.height:.1f}"'
        f' rx="{radius}" fill="{colour}" stroke="#777"/>'
    )


def _arrow(source: Rectangle, target: Rectangle) -> str:
    """From the lower edge of one box to the upper edge of another."""
    start = (source.x + source.width / 2, source.y + source.height)
    end = (target.x + target.width / 2, target.y)
    bend = f"C{start[0]:.1f} {start[1] + 14:.1f} {end[0]:.1f} {end[1] - 14:.1f}"
    return (
        f'<path d="M{start[0]:.1f} {start[1]:.1f}{bend} {end[0]:.1f} {end[1]:.1f}"'
        ' fill="none" stroke="#555" marker-end="url(#tip)"/>'
    )


def _crossing(source: Rectangle, target: Rectangle) -> str:
    """A thick arrow between rooms."""
    narrow = min(source, target, key=lambda rectangle: rectangle.width)
    x = narrow.x + narrow.width / 2
    top, end = source.y + source.height, target.y - 3
    return (
        f'<path d="M{x:.1f} {top:.1f}L{x:.1f} {end:.1f}" stroke="#333" stroke-width="3"'
        ' marker-end="url(#tip)"/>'
    )


def crossings(graph: Graph) -> set[tuple[str, str]]:
    """Pairs of rooms: the first imports from the second."""
    room_of = {package: room for room, package in ROOMS.items()}
    pairs = {
        (room_of[module.split(".")[0]], room_of[target.split(".")[0]])
        for module, targets in graph.items()
        for target in targets
    }
    return {(source, target) for source, target in pairs if source != target}


if __name__ == "__main__":
    modules = product_modules()
    graph = import_graph(modules)
    fresh = draw(box_graph(graph), crossings(graph))
    sys.exit(FRESH["write_or_check"]({PICTURE: fresh}))
