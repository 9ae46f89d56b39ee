"""The nine indenters of the paper, by name.

Tips have the published dimensions (public meshes of eight indenters, NVlabs/biotac_sim), checked
vertex by vertex in the tests. The bodies behind, which narrow towards a 7.2 mm square base at
z = -17.859 mm and which no skin reaches, are slabs that follow the published ones within 1 mm.

The paper names eight: *sphere small*, *medium*, *large*, *cylinder small*, *cylinder long*, *cube*,
*ring*, *texture*; `cylinder_medium` is our word for the short cylinder of 7 mm diameter.

*texture* is unpublished but for a small figure and one sentence: it "modeled scattered grains and
debris". `texture` here is a **stand-in**: a rounded plate with hemispherical grains whose places
and sizes follow a fixed sequence, with fillets between them. Results with it say nothing about the
paper's texture.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable
from functools import cache

from palpate.errors import ConfigError
from palpate_fem.indenter.shape import Indenter, Primitive, PrimitiveKind

BASE_M = -17.859e-3
_SHAFT_M = 3.6e-3  # half width of the square base; the published one is 3.6 x 3.612 mm
_EDGE_M = 1.0e-3  # radius of all rounded edges
_SLABS = 4  # of a body that narrows
_CREASE_M = 0.1e-3  # radius of edges that no skin reaches

# Public file names; their lengths are diameters.
ALIASES = {
    "sphere_3-5mm": "sphere_small",
    "sphere_7mm": "sphere_medium",
    "sphere_14mm": "sphere_large",
    "cylinder_short_3-5mm": "cylinder_small",
    "cylinder_short_7mm": "cylinder_medium",
    "cylinder_long_7mm": "cylinder_long",
    "cube_14mm": "cube",
    "ring_7mm": "ring",
}


def _ball(radius_m: float) -> Primitive:
    """A sphere that touches the tip."""
    return _grain((0.0, 0.0, -radius_m), radius_m)


def _grain(centre_m: tuple[float, float, float], radius_m: float) -> Primitive:
    return Primitive(PrimitiveKind.REVOLVED, centre_m, (0.0, 0.0, 0.0, 0.0), radius_m)


def _disc(radius_m: float, low_m: float, high_m: float, edge_m: float) -> Primitive:
    """An upright cylinder whose two rims are rounded."""
    return Primitive(
        PrimitiveKind.REVOLVED,
        (0.0, 0.0, 0.0),
        (0.0, radius_m - edge_m, low_m + edge_m, high_m - edge_m),
        edge_m,
    )


def _block(
    half_x_m: float, half_y_m: float, low_m: float, high_m: float, edge_m: float
) -> Primitive:
    """An upright box whose twelve edges are rounded."""
    return Primitive(
        PrimitiveKind.BOX,
        (0.0, 0.0, (low_m + high_m) / 2),
        (half_x_m - edge_m, half_y_m - edge_m, (high_m - low_m) / 2 - edge_m, 0.0),
        edge_m,
    )


def _slabs(from_m: float) -> list[tuple[float, float, float]]:
    """A body from z = from_m to the base in slabs: (fraction of the way, low, high) of each."""
    height = (from_m - BASE_M) / _SLABS
    return [
        ((slab + 0.5) / _SLABS, from_m - (slab + 1) * height, from_m - slab * height)
        for slab in range(_SLABS)
    ]


def _narrowing(half_x_m: float, half_y_m: float, from_m: float) -> tuple[Primitive, ...]:
    """Blocks that narrow from a rectangle at z = from_m to the square base."""
    blocks = []
    for fraction, low, high in _slabs(from_m):
        x = half_x_m + fraction * (_SHAFT_M - half_x_m)
        y = half_y_m + fraction * (_SHAFT_M - half_y_m)
        blocks.append(_block(x, y, low, high, _CREASE_M))
    return tuple(blocks)


def _circle_to_square(radius_m: float) -> tuple[Primitive, ...]:
    """Discs and blocks that narrow from a circle at z = -radius to the square base."""
    parts = []
    for fraction, low, high in _slabs(-radius_m):
        side = radius_m + fraction * (_SHAFT_M - radius_m)
        corner = radius_m / math.sqrt(2.0) + fraction * (_SHAFT_M - radius_m / math.sqrt(2.0))
        parts.append(_disc(side, low, high, _CREASE_M))
        parts.append(_block(corner, corner, low, high, _CREASE_M))
    return tuple(parts)


def _sphere_small() -> tuple[Primitive, ...]:
    """R 1.75 on a rod that flares, by an arc of 10 mm, into a plate 23.5 mm wide."""
    radius, plate, arc = 1.75e-3, 11.75e-3, 10e-3
    start = BASE_M + arc
    rod = _disc(radius, BASE_M, -radius + _CREASE_M, _CREASE_M)
    steps = []
    for depth in (4.5e-3, 6.5e-3, 8e-3, 9e-3, 9.7e-3):
        wide = plate - math.sqrt(arc**2 - (depth + 0.15e-3) ** 2)
        steps.append(_disc(wide, BASE_M, start - depth, 0.05e-3))
    return (_ball(radius), rod, *steps, _disc(plate, BASE_M, BASE_M + 0.05e-3, 0.025e-3))


def _sphere_on_rod(radius_m: float) -> tuple[Primitive, ...]:
    return _ball(radius_m), _disc(radius_m, BASE_M, -radius_m + _CREASE_M, _CREASE_M)


def _sphere_on_shaft(radius_m: float) -> tuple[Primitive, ...]:
    return _ball(radius_m), *_circle_to_square(radius_m)


def _lying(radius_m: float, half_flat_m: float) -> Primitive:
    """A cylinder along x whose top touches the tip, its ends rounded."""
    return Primitive(
        PrimitiveKind.REVOLVED,
        (0.0, 0.0, -radius_m),
        (0.0, radius_m - _EDGE_M, -half_flat_m, half_flat_m),
        _EDGE_M,
        axis=0,
    )


def _short_cylinder(radius_m: float) -> tuple[Primitive, ...]:
    """7 mm long; its upright body has the same outline, and a wider foot."""
    half = 3.5e-3
    body = _block(half, radius_m, BASE_M, -radius_m + _EDGE_M, _EDGE_M)
    # The foot: a fillet of 3 mm round the body.
    foot = [
        _block(half + out, radius_m + out, BASE_M, BASE_M + up, 0.1e-3)
        for out, up in ((2.4e-3, 0.3e-3), (1.1e-3, 0.75e-3), (0.4e-3, 1.6e-3))
    ]
    return (_lying(radius_m, half - _EDGE_M), body, *foot)


def _cylinder_long() -> tuple[Primitive, ...]:
    radius, half = 3.5e-3, 14e-3
    body = _block(half, radius, -7.7e-3, -radius + _EDGE_M, _EDGE_M)
    return (_lying(radius, half - _EDGE_M), body, *_narrowing(half, radius, -7e-3))


def _cube() -> tuple[Primitive, ...]:
    """14 mm wide, flat tip 12 x 12 mm."""
    return _block(7e-3, 7e-3, -8e-3, 0.0, _EDGE_M), *_narrowing(7e-3, 7e-3, -7e-3)


def _ring() -> tuple[Primitive, ...]:
    """Outer radius 7 mm, bore 3.5 mm and 7 mm deep, flat from 4.5 to 6 mm."""
    wall = Primitive(
        PrimitiveKind.REVOLVED,
        (0.0, 0.0, 0.0),
        (3.5e-3 + _EDGE_M, 7e-3 - _EDGE_M, -7e-3, -_EDGE_M),
        _EDGE_M,
    )
    return wall, *_circle_to_square(7e-3)


def _texture() -> tuple[Primitive, ...]:
    """Stand-in: grains of radius 0.5-1.0 mm on a plate of 14 x 14 mm, 0.5-1.0 mm high.

    Places follow the golden angle (a sunflower: even, but nowhere regular); sizes the fractional
    parts of multiples of sqrt(2). The highest grain, in the middle, touches the tip. Creases have
    fillets of 0.5 mm, a radius chosen for robustness. Over a crease the direction of the distance
    jumps at the centres of its arc. Faces of skin hang there over the valleys between grains, 0.45
    mm up and more, and contact weighs them too: with fillets of 0.15 and 0.3 mm it often does not
    come to rest, with these seldom.
    """
    grains, reach, largest = 24, 6e-3, 1.0e-3
    golden = math.pi * (3.0 - math.sqrt(5.0))
    parts = [_block(7e-3, 7e-3, -8e-3, -largest, 0.5e-3)]
    for k in range(grains):
        far = reach * math.sqrt(k / (grains - 1))
        radius = largest * (1.0 - 0.5 * math.fmod(k * math.sqrt(2.0), 1.0))
        centre = (far * math.cos(k * golden), far * math.sin(k * golden), -largest)
        parts.append(_grain(centre, radius))
    return (*parts, *_narrowing(7e-3, 7e-3, -7.5e-3))


def _plate() -> tuple[Primitive, ...]:
    """40 x 24 mm, 5 mm thick: larger than what a finger touches of a table or a force sensor."""
    return (_block(20e-3, 12e-3, -5e-3, 0.0, _EDGE_M),)


_MAKERS: dict[str, Callable[[], tuple[Primitive, ...]]] = {
    "sphere_small": _sphere_small,
    "sphere_medium": lambda: _sphere_on_rod(3.5e-3),
    "sphere_large": lambda: _sphere_on_shaft(7.0e-3),
    "cylinder_small": lambda: _short_cylinder(1.75e-3),
    "cylinder_medium": lambda: _short_cylinder(3.5e-3),
    "cylinder_long": _cylinder_long,
    "cube": _cube,
    "ring": _ring,
    "texture": _texture,
}
_BESIDE: dict[str, Callable[[], tuple[Primitive, ...]]] = {"plate": _plate}
"""Not the paper's: to be named where they are wanted."""

_FILLETS_M = {"texture": 0.5e-3}

_SIZED = re.compile(r"(?P<kind>sphere|cylinder_short)_(?P<diameter>\d+(-\d+)?)mm")
_DIAMETERS_MM = (3.0, 14.0)

BETWEEN = ("sphere_5mm", "sphere_10mm", "cylinder_short_5mm", "cylinder_short_10mm")
"""Sizes between the paper's, for data sets that are to hold more than nine indenters."""


def _sized(name: str) -> tuple[Primitive, ...] | None:
    """A sphere, or a cylinder 7 mm long, of any diameter within limits; None = no such name."""
    found = _SIZED.fullmatch(name)
    if found is None:
        return None
    diameter_mm = float(found["diameter"].replace("-", "."))
    low, high = _DIAMETERS_MM
    if not low <= diameter_mm <= high:
        raise ConfigError(
            f"an indenter {name!r} of {diameter_mm:g} mm",
            remedy=f"give a diameter from {low:g} to {high:g} mm",
        )
    radius_m = 0.5e-3 * diameter_mm
    if found["kind"] == "cylinder_short":
        return _short_cylinder(radius_m)
    return _sphere_on_rod(radius_m) if radius_m <= _SHAFT_M else _sphere_on_shaft(radius_m)


def indenter_names() -> tuple[str, ...]:
    """The nine names, in the paper's order of kinds."""
    return tuple(_MAKERS)


@cache
def make_indenter(name: str) -> Indenter:
    """An indenter of the catalogue.

    Args:
        name: One of `indenter_names`, ``plate``, or the public file's name, such as ``sphere_7mm``.
            Of spheres and short cylinders there are other diameters, too: ``sphere_5mm``,
            ``cylinder_short_4-5mm``; those above 7.2 mm narrow to the paper's base.

    Raises:
        ConfigError: There is none of that name; the nearest is suggested.
    """
    key = ALIASES.get(name, name)
    if (sized := _sized(key)) is not None:
        return Indenter(key, sized)
    makers = _MAKERS | _BESIDE
    if key not in makers:
        known = (*makers, *ALIASES)
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
        raise ConfigError(
            f"there is no indenter {name!r}",
            remedy=f"did you mean {near[0]!r}? known: {', '.join(makers)}",
        )
    return Indenter(key, makers[key](), _FILLETS_M.get(key, 0.0))
