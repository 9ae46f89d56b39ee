"""The nine indenters: names, dimensions, and the public meshes of eight of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.errors import ConfigError
from palpate_fem.indenter.catalogue import ALIASES, BASE_M, indenter_names, make_indenter
from palpate_fem.indenter.distance import signed_distance
from palpate_fem.indenter.shape import PrimitiveKind

Floats = NDArray[np.float64]

# z above which a public mesh is the tip, which touches the skin; its vertices are given to 1 um.
# Of the small sphere all of the straight rod counts, of the short cylinders the straight body.
TIP_M = {
    "sphere_small": -7.8e-3,
    "sphere_medium": -17.8e-3,
    "sphere_large": -7.0e-3,
    "cylinder_small": -14.8e-3,
    "cylinder_medium": -14.8e-3,
    "cylinder_long": -6.5e-3,
    "cube": -7.0e-3,
    "ring": -6.99e-3,
}
TIP_ERROR_M = 1e-6
BODY_ERROR_M = 0.75e-3  # of slabs that stand for slopes and fillets no skin reaches


def vertices(file: Path) -> Floats:
    """Vertices of a public mesh [m], turned into the indenter frame, shape (N, 3)."""
    rows = [line.split()[1:4] for line in file.read_text().splitlines() if line.startswith("v ")]
    points = np.array(rows, np.float64)
    if np.ptp(points[:, 1]) > 1.0:
        points *= 1e-3
    return np.stack([-points[:, 0], points[:, 2], points[:, 1]], axis=1)


def along_axis(name: str, axis: int) -> float:
    """Half width of an indenter along an axis through z = -2.5 mm [m], by bisection."""
    point, low, high = np.array([[0.0, 0.0, -2.5e-3]]), 0.0, 0.05
    for _ in range(60):
        point[0, axis] = (low + high) / 2
        inside = signed_distance(make_indenter(name), point)[0] < 0.0
        low, high = ((low + high) / 2, high) if inside else (low, (low + high) / 2)
    return low


def test_there_are_nine() -> None:
    assert len(indenter_names()) == 9
    assert set(ALIASES.values()) == set(indenter_names()) - {"texture"}


@pytest.mark.parametrize(("alias", "name"), ALIASES.items())
def test_public_file_names_are_understood(alias: str, name: str) -> None:
    assert make_indenter(alias).name == name


@pytest.mark.parametrize(
    ("wrong", "near"), [("sphere_larg", "sphere_large"), ("Cube", "cube"), ("", "cube")]
)
def test_an_unknown_name_is_refused_with_the_nearest(wrong: str, near: str) -> None:
    with pytest.raises(ConfigError, match="there is no indenter") as caught:
        make_indenter(wrong)
    assert near in str(caught.value)


@pytest.mark.parametrize("name", indenter_names())
def test_the_frame_is_that_of_the_convention(name: str) -> None:
    grid = np.linspace(-15e-3, 15e-3, 121)
    x, y = (part.ravel() for part in np.meshgrid(grid, grid))
    plane = np.stack([x, y, np.zeros_like(x)], axis=1)
    at_tip = signed_distance(make_indenter(name), plane).min()
    assert 0.0 <= at_tip < 1e-9  # touches z = 0 from below
    base = plane + np.array([0.0, 0.0, BASE_M])
    assert -1e-9 < signed_distance(make_indenter(name), base).min() < 1e-9
    bore = name == "ring"
    assert (signed_distance(make_indenter(name), np.zeros((1, 3)))[0] > 1e-3) == bore


@pytest.mark.parametrize(
    ("name", "diameter_m"),
    [("sphere_5mm", 5e-3), ("sphere_4-5mm", 4.5e-3), ("sphere_10mm", 10e-3), ("sphere_3mm", 3e-3),
     ("cylinder_short_5mm", 5e-3), ("cylinder_short_10mm", 10e-3), ("cylinder_short_14mm", 14e-3)],
)  # fmt: skip
def test_spheres_and_short_cylinders_have_any_diameter(name: str, diameter_m: float) -> None:
    indenter, radius = make_indenter(name), 0.5 * diameter_m
    assert indenter.name == name
    angles = np.linspace(-1.2, 1.2, 25)
    round_tip = np.stack([0 * angles, radius * np.sin(angles), radius * (np.cos(angles) - 1)], 1)
    np.testing.assert_allclose(signed_distance(indenter, round_tip), 0.0, atol=1e-9)
    beside = np.array([[3.4e-3, 0.0, -radius]])  # a cylinder is 7 mm long, a sphere is round
    inside = name.startswith("cylinder") or radius > 3.4e-3
    assert (signed_distance(indenter, beside)[0] < 0.0) == inside


@pytest.mark.parametrize("name", ["sphere_2mm", "sphere_20mm", "cylinder_short_0mm"])
def test_a_diameter_that_no_mesh_resolves_or_no_finger_takes_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="give a diameter from 3 to 14 mm"):
        make_indenter(name)


def test_the_names_of_the_paper_mean_what_they_meant() -> None:
    assert make_indenter("sphere_7mm").name == "sphere_medium"
    assert make_indenter("cylinder_short_7mm").name == "cylinder_medium"


def test_dimensions_are_the_published_ones() -> None:
    assert along_axis("sphere_medium", 0) == pytest.approx(np.sqrt(3.5**2 - 1.0) * 1e-3)
    assert along_axis("sphere_large", 1) == pytest.approx(np.sqrt(7.0**2 - 4.5**2) * 1e-3)
    assert along_axis("sphere_small", 0) == pytest.approx(1.75e-3)
    assert along_axis("cylinder_small", 0) == pytest.approx(3.5e-3)
    assert along_axis("cylinder_small", 1) == pytest.approx(1.75e-3)
    assert along_axis("cylinder_long", 0) == pytest.approx(14e-3)
    assert along_axis("cube", 0) == pytest.approx(7e-3)
    profile = np.array([[r, 0.0, -2.5e-3] for r in (3.5e-3, 7.0e-3, 5.25e-3)])
    np.testing.assert_allclose(
        signed_distance(make_indenter("ring"), profile), [0.0, 0.0, -1.75e-3], atol=1e-15
    )
    corners = np.array([[6e-3, 6e-3, 0.0], [6e-3, -6e-3, 0.0], [7e-3, 6e-3, -1e-3]])
    np.testing.assert_allclose(signed_distance(make_indenter("cube"), corners), 0.0, atol=1e-15)
    plate = np.array([[11.75e-3 - 25e-6, 0.0, BASE_M + 50e-6]])
    assert signed_distance(make_indenter("sphere_small"), plate)[0] == pytest.approx(0.0, abs=1e-9)


def test_the_texture_is_a_fixed_set_of_grains_on_a_plate() -> None:
    grains = [p for p in make_indenter("texture").primitives if p.kind == PrimitiveKind.REVOLVED]
    assert len(grains) == 24
    radii = np.array([p.rounding for p in grains])
    assert (radii.min(), radii.max()) == (pytest.approx(0.5e-3, abs=25e-6), 1e-3)
    centres = np.array([p.centre for p in grains])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) + np.eye(24)
    assert (apart > (radii[:, None] + radii[None])).mean() > 0.99  # nearly all stand alone
    np.testing.assert_array_equal(centres[:2, 2], -1e-3)
    assert {n for n in indenter_names() if make_indenter(n).fillet_m > 0.0} == {"texture"}
    make_indenter.cache_clear()
    np.testing.assert_array_equal(
        [p.centre for p in make_indenter("texture").primitives if p.kind == PrimitiveKind.REVOLVED],
        centres,
    )


@pytest.mark.parametrize(("stem", "name"), ALIASES.items())
def test_public_vertices_lie_on_the_tip(shared_data: Path, stem: str, name: str) -> None:
    folder = shared_data / "nvlabs_biotac_mesh" / "meshes" / "indenters"
    points = vertices(folder / f"{stem}.obj")
    gap = np.abs(signed_distance(make_indenter(name), points))
    tip = points[:, 2] > TIP_M[name]
    assert tip.sum() >= 50
    assert gap[tip].max() < TIP_ERROR_M
    assert gap[~tip].max() < BODY_ERROR_M
    assert points[:, 2].min() == pytest.approx(BASE_M, abs=1e-6)
