"""Paths on the skin: the paper's targets, presses and whole campaign, and chains of segments.

At each of 10 points of the pad there is one indentation along the inward normal, 3 mm deep, and
four at 30 degrees to it, 1.5 mm deep (paper, "Experimental testing procedure"). The paper
leaves the following open; we chose:

* the *sampled region*: x from -11 to 1 mm, at most 4 mm to the side, where the skin faces down:
  from the core's distal facet over the pad, well within the skin's ends at x = -21 and 7 mm;
* the azimuths of the angled ones: distal, +y, proximal, -y;
* the indenter faces where it moves, so that a flat one comes on with an edge when angled, and
  touches far from the point it aims at, as the paper reports;
* a path starts just clear of the skin, not 3 mm away, and its 20 steps are equal parts of the depth
  from first contact on, the displacements to which the paper resamples.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.errors import ConfigError, SimulationError
from palpate.rigid import LEVER_M, facing, quaternions_of, rotation_matrices, unit
from palpate_fem.arrays import Floats
from palpate_fem.indenter.approach import OuterSurface, first_contact
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.distance import TOUCH_M, signed_distance
from palpate_fem.indenter.path import POSES_MOST, PathSegment, check_path, show_segments
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mesh.surface import node_normals

STEPS = 20  # paper, "Finite element model configuration"
POINTS = 10  # per indenter; paper, "Experimental testing procedure", as are the next four
NORMAL_DEPTH_M = 3.0e-3
ANGLED_DEPTH_M = 1.5e-3
ANGLE_RAD = math.radians(30.0)
AZIMUTHS = 4
_BATCH = 64  # of draws; fixed, so that asking for more points does not change the first ones
STEP_M = NORMAL_DEPTH_M / STEPS
"""Longest step of a path of segments [m], as `path_lengths` counts: that of the paper's presses."""

CLEARANCE_M = 0.05e-3  # gaps that are means over faces close before the skin is touched: by 16 um


@dataclass(frozen=True, slots=True)
class Region:
    """Part of the outer surface in which targets lie [m], sensor frame; our choice, see above."""

    x_from_m: float = -11e-3
    x_to_m: float = 1e-3
    half_width_m: float = 4e-3

    def holds(self, points: Floats, normals: Floats) -> NDArray[np.bool_]:
        """Whether each point lies in it, below the axis and facing down, shape (N,)."""
        x, y, z = points.T
        held = (x >= self.x_from_m) & (x <= self.x_to_m) & (np.abs(y) <= self.half_width_m)
        return np.asarray(held & (z < 0.0) & (normals[:, 2] < -0.5))


@dataclass(frozen=True)
class PlannedIndentation:
    """One planned trajectory; its poses are made when they are asked for.

    Attributes:
        name: ``<indenter>/<point>/<normal|angled-0..3>``.
        indenter: Name of the indenter.
        target: Point on the line of the tip [m], shape (3,).
        normal: Outward normal there, shape (3,).
        direction: Direction of travel, shape (3,).
        depth_m: Travel from first contact to the last pose [m].
        steps: Number K of equal steps from first contact on.
        surface: The skin that is pressed.
    """

    name: str
    indenter: str
    target: Floats
    normal: Floats
    direction: Floats
    depth_m: float
    steps: int
    surface: OuterSurface

    @property
    def path(self) -> Floats:
        """Poses, the first clear of the skin, shape (K + 1, 7); takes some milliseconds.

        Raises:
            SimulationError: The indenter passes the skin.
        """
        return self._straight[0]

    @property
    def contact_m(self) -> float:
        """Travel of the tip beyond the target at first contact [m]; mostly negative.

        Raises:
            SimulationError: The indenter passes the skin.
        """
        return self._straight[1]

    @cached_property
    def _straight(self) -> tuple[Floats, float]:
        return _straight_path(
            make_indenter(self.indenter),
            self.target,
            self.direction,
            self.surface,
            self.depth_m,
            self.steps,
            CLEARANCE_M,
        )


def press_path(
    indenter: Indenter,
    target: ArrayLike,
    direction: ArrayLike,
    surface: OuterSurface,
    *,
    depth_m: float,
    steps: int = STEPS,
    clearance_m: float = CLEARANCE_M,
) -> Floats:
    """A straight path into the skin: a pose just clear of it, then equal steps from first contact.

    Args:
        indenter: The indenter; it faces where it moves.
        target: Point through which the tip goes [m], shape (3,), sensor frame.
        direction: Where it moves, shape (3,).
        surface: Outer surface of the pressurised skin.
        depth_m: Travel from first contact to the last pose [m].
        steps: Number K of steps.
        clearance_m: Travel from the first pose to first contact [m].

    Returns:
        Poses, shape (K + 1, 7).

    Raises:
        ConfigError: A value is out of range.
        SimulationError: The indenter passes the skin.
    """
    return _straight_path(indenter, target, direction, surface, depth_m, steps, clearance_m)[0]


def segment_path(
    indenter: Indenter,
    target: ArrayLike,
    normal: ArrayLike,
    segments: Sequence[PathSegment],
    surface: OuterSurface,
    *,
    step_m: float = STEP_M,
    clearance_m: float = CLEARANCE_M,
) -> Floats:
    """A path that follows segments one after the other, each in equal steps.

    It begins just clear of the skin, facing where the first segment, a press, leads, and turned
    about its axis as that says. Later presses do not turn the indenter. Directions are those of the
    target's plane, also where a slide or a roll has left it: they do not follow the curved skin.

    Args:
        indenter: The indenter.
        target: Point of the skin [m], shape (3,), sensor frame.
        normal: Outward normal there, shape (3,).
        segments: What it does; see `parse_segments`.
        surface: Outer surface of the pressurised skin.
        step_m: Longest step [m], turns as `path_lengths` counts them.
        clearance_m: How far from the skin a path begins, and an unloading ends [m].

    Returns:
        Poses, shape (K + 1, 7).

    Raises:
        ConfigError: A value is out of range, the first segment is not a press, or there are too
            many steps.
        SimulationError: A press that counts from first contact passes the skin; names it.
    """
    if not (math.isfinite(step_m) and step_m > 0.0):
        raise ConfigError(f"step_m = {step_m} is not a length", remedy="give it in metres, > 0")
    if not segments or segments[0].kind != "press":
        raise ConfigError("the path does not begin with a press", remedy="press first")
    out = unit(normal, "normal")
    moves: list[Floats] = []
    clear = True  # whether it is out of the skin, so that a press counts from first contact
    for segment in segments:
        if not moves or (clear and segment.kind == "press"):
            direction = angled_direction(out, segment.angle_rad, segment.azimuth_rad)
            depth_m = _amount(segment)
            if not moves:
                steps = _steps(depth_m, step_m)
                path, _ = _straight_path(
                    indenter,
                    target,
                    direction,
                    surface,
                    depth_m,
                    steps,
                    clearance_m,
                    turn_rad=segment.turn_rad,
                )
                moves.append(path)
            else:
                at = moves[-1][-1]
                touch = _first_touch(indenter, at, direction, surface)
                if not -TOUCH_M <= touch < math.inf:
                    raise SimulationError(
                        f"{show_segments([segment])!r} passes the fingertip without touching it",
                        remedy="slide back over the finger before it, or press more steeply",
                    )
                way = touch + depth_m
                moves.append(_moved(at, way * direction, _steps(way, step_m)))
            clear = False
            continue
        at = moves[-1][-1]
        moves.append(_segment_poses(indenter, at, out, segment, surface, step_m, clearance_m))
        clear = _first_touch(indenter, moves[-1][-1], -out, surface) > 0.0
    return check_path(np.concatenate(moves), source="the path of these segments")


def _segment_poses(
    indenter: Indenter,
    at: Floats,
    out: Floats,
    segment: PathSegment,
    surface: OuterSurface,
    step_m: float,
    clearance_m: float,
) -> Floats:
    """Poses of a segment after the first, without the one that it begins at, shape (K, 7)."""
    along = angled_direction(out, 0.5 * math.pi, segment.azimuth_rad)
    if segment.kind == "press":
        amount = _amount(segment)
        direction = angled_direction(out, segment.angle_rad, segment.azimuth_rad)
        return _moved(at, amount * direction, _steps(amount, step_m))
    if segment.kind == "slide":
        amount = _amount(segment)
        return _moved(at, amount * along, _steps(amount, step_m))
    if segment.kind == "unload":
        if segment.amount is None:  # back to where it would touch if it came along the normal
            amount = clearance_m - min(0.0, _first_touch(indenter, at, -out, surface))
        else:
            amount = _amount(segment)
        return _moved(at, amount * out, _steps(amount, step_m))
    angle, turn = _amount(segment), rotation_matrices(at[3:])
    if segment.kind == "twist":
        angles = angle * _shares(_steps(LEVER_M * abs(angle), step_m))
        turned = turn @ _turns((0.0, 0.0, 1.0), angles)
        return np.hstack([np.tile(at[:3], (len(angles), 1)), quaternions_of(turned)])
    if segment.kind != "roll":
        raise ConfigError(f"{segment.kind!r} is no segment of a path", remedy="see parse_segments")
    # About the middle of the tip's curvature, which moves along by as much as the tip rolls off:
    # no slip where it touches. The middle of a flat tip is the tip.
    radius = _tip_radius(indenter, turn.T @ along)
    angles = angle * _shares(_steps(max(radius, LEVER_M) * abs(angle), step_m))
    turned = _turns(np.cross(out, along), angles) @ turn
    middle = at[:3] - radius * turn[:, 2] + (radius * angles)[:, None] * along
    return np.hstack([middle + radius * turned[:, :, 2], quaternions_of(turned)])


def _amount(segment: PathSegment) -> float:
    turns = segment.kind in ("twist", "roll")
    value = math.nan if segment.amount is None else segment.amount
    if not math.isfinite(value) or value == 0.0 or (value < 0.0 and not turns):
        raise ConfigError(
            f"{segment.kind} by {segment.amount}",
            remedy="give an angle [rad], not 0" if turns else "give metres, > 0",
        )
    return value


def _steps(way_m: float, step_m: float) -> int:
    """Number of equal steps of at most ``step_m``; a share of a micrometre makes no step more."""
    count = way_m / step_m
    if count > POSES_MOST:  # before arrays are made of them
        raise ConfigError(
            f"a segment of {1e3 * way_m:.3g} mm in steps of {1e3 * step_m:.3g} mm has {count:.3g} "
            f"poses, at most {POSES_MOST:,} are simulated",
            remedy="make the steps longer",
        )
    return max(1, math.ceil(count - 1e-6))


def _shares(steps: int) -> Floats:
    return np.arange(1, steps + 1) / steps


def _moved(at: Floats, way: Floats, steps: int) -> Floats:
    """Poses on a straight way from a pose, which is left out, shape (steps, 7)."""
    poses = np.tile(at, (steps, 1))
    poses[:, :3] += _shares(steps)[:, None] * way
    return poses


def _turns(axis: ArrayLike, angles: Floats) -> Floats:
    """Rotations about a unit axis, shape (K, 3, 3)."""
    half = 0.5 * angles[:, None]
    return rotation_matrices(np.hstack([np.cos(half), np.sin(half) * np.asarray(axis)]))


def _first_touch(indenter: Indenter, at: Floats, direction: Floats, surface: OuterSurface) -> float:
    """Way from a pose to first contact with the untouched skin [m]; negative from inside it.

    An indenter that has slid beside the finger touches nothing: infinite.
    """
    try:
        return first_contact(indenter, at[3:], at[:3], direction, surface)
    except SimulationError:
        return math.inf


_NEAR_TIP_M = 0.1e-3


def _tip_radius(indenter: Indenter, along: Floats) -> float:
    """Radius of curvature of the tip in a direction of the indenter frame (3,) [m]; 0 = flat.

    A point beside the tip of a ball of radius R is sqrt(R^2 + h^2) - R away from it.
    """
    aside = np.array([along[0], along[1], 0.0])
    aside *= _NEAR_TIP_M / max(float(np.linalg.norm(aside)), 1e-12)
    tip, gap = signed_distance(indenter, np.stack([np.zeros(3), aside]))
    if abs(tip) > 1e-9 or gap < 1e-9:  # no surface at the tip, as in a ring's bore; or flat
        return 0.0
    return float((_NEAR_TIP_M**2 - gap**2) / (2.0 * gap))


def angled_direction(normal: ArrayLike, angle_rad: float, azimuth_rad: float) -> Floats:
    """Direction at an angle to the inward normal, shape (3,), sensor frame.

    Args:
        normal: Outward normal of the skin, shape (3,).
        angle_rad: Angle to the inward normal.
        azimuth_rad: Where it moves along the skin: 0 distally, a quarter turn towards +y (on the
            pad), half a turn proximally.
    """
    out = unit(normal, "normal")
    distal = np.array([1.0, 0.0, 0.0]) - out[0] * out
    if np.linalg.norm(distal) < 1e-6:  # at the very tip: dorsal takes the place of distal
        distal = np.array([0.0, 0.0, 1.0]) - out[2] * out
    distal = unit(distal)
    along = math.cos(azimuth_rad) * distal + math.sin(azimuth_rad) * np.cross(distal, out)
    return unit(-math.cos(angle_rad) * out + math.sin(angle_rad) * along)


def sample_targets(
    surface: OuterSurface,
    count: int,
    *,
    seed: int | Sequence[int] = 0,
    region: Region | None = None,
) -> tuple[Floats, Floats]:
    """Random points of a region of the surface, uniform by area.

    Args:
        surface: Outer surface of the pressurised skin.
        count: Number of points.
        seed: The same seed and surface give the same points; a larger count adds to them.
        region: Where; None = the sampled region.

    Returns:
        Points [m] and outward unit normals, both shape (count, 3), sensor frame.

    Raises:
        ConfigError: The surface has no such region.
    """
    region = Region() if region is None else region
    faces = surface.triangles
    corner = surface.nodes[faces]
    smooth = node_normals(surface.nodes, surface.faces)[faces]
    inside = region.holds(corner.reshape(-1, 3), smooth.reshape(-1, 3)).reshape(-1, 3).any(axis=1)
    if not inside.any():
        raise ConfigError(
            f"no part of the surface lies in {region}",
            remedy="give the outer surface in the sensor frame, in metres, normals outwards",
        )
    corner, smooth = corner[inside], smooth[inside]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    random = np.random.default_rng(seed)
    points, normals = np.empty((0, 3)), np.empty((0, 3))
    while len(points) < count:  # faces at the border reach out of the region: draw again
        face = random.choice(len(corner), size=_BATCH, p=area / area.sum())
        weights = random.dirichlet((1.0, 1.0, 1.0), size=_BATCH)
        drawn = np.einsum("nk,nki->ni", weights, corner[face])
        normal = np.einsum("nk,nki->ni", weights, smooth[face])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        kept = region.holds(drawn, normal)
        points, normals = np.vstack([points, drawn[kept]]), np.vstack([normals, normal[kept]])
    return points[:count], normals[:count]


@dataclass(frozen=True, slots=True)
class Campaign:
    """All indentations of the paper on a surface, in order, made one by one; 450 by default.

    The points of an indenter depend only on the seed, the surface and its name; a larger number of
    points adds to them.

    Attributes:
        surface: Outer surface of the pressurised skin.
        indenters: Names.
        points: Points for each indenter.
        seed: Of the points.
        steps: Steps of each path.
        region: Where the targets lie; None = the sampled region.
        angled: Number of angled paths at each point, at most ``AZIMUTHS``.
        increment_m: Length of a step [m] instead of ``steps``, as a robot moves; None = ``steps``.
        overtravel_m: Depth beyond the paper's [m], which a robot with a registration error reaches.
    """

    surface: OuterSurface
    indenters: tuple[str, ...] = indenter_names()
    points: int = POINTS
    seed: int = 0
    steps: int = STEPS
    region: Region | None = None
    angled: int = AZIMUTHS
    increment_m: float | None = None
    overtravel_m: float = 0.0

    def __len__(self) -> int:
        return len(self.indenters) * self.points * (1 + self.angled)

    def __iter__(self) -> Iterator[PlannedIndentation]:
        ways = [("normal", 0.0, 0.0, NORMAL_DEPTH_M)] + [
            (f"angled-{k}", ANGLE_RAD, 2.0 * math.pi * k / AZIMUTHS, ANGLED_DEPTH_M)
            for k in range(self.angled)
        ]
        for name in self.indenters:
            indenter = make_indenter(name)
            key = [self.seed, *indenter.name.encode()]
            aims = sample_targets(self.surface, self.points, seed=key, region=self.region)
            for point, (target, normal) in enumerate(zip(*aims, strict=True)):
                for way, angle, azimuth, paper_depth_m in ways:
                    direction = angled_direction(normal, angle, azimuth)
                    depth_m = paper_depth_m + self.overtravel_m
                    steps = self.steps
                    if self.increment_m is not None:
                        steps = round(depth_m / self.increment_m)
                    at = f"{indenter.name}/{point:02d}/{way}"
                    yield PlannedIndentation(
                        at,
                        indenter.name,
                        target,
                        normal,
                        direction,
                        depth_m,
                        steps,
                        self.surface,
                    )


def points_first(campaign: Campaign) -> list[PlannedIndentation]:
    """A campaign's indentations, the first point of every indenter first, then the second ones.

    What is there early is then a fair sample, and those that take long do not all come last.
    """
    return sorted(campaign, key=lambda plan: (*plan.name.split("/")[1:], plan.name))


def _straight_path(
    indenter: Indenter,
    target: ArrayLike,
    direction: ArrayLike,
    surface: OuterSurface,
    depth_m: float,
    steps: int,
    clearance_m: float,
    *,
    turn_rad: float = 0.0,
) -> tuple[Floats, float]:
    """`press_path`, and the travel beyond the target at first contact [m].

    ``turn_rad`` is how far the indenter is turned about its axis.
    """
    if not 1 <= steps < POSES_MOST:  # before arrays are made of them
        raise ConfigError(f"a path of {steps} steps", remedy=f"ask for 1 to {POSES_MOST - 1}")
    for what, value in (("depth_m", depth_m), ("clearance_m", clearance_m)):
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigError(f"{what} = {value} is not a length", remedy="give it in metres, > 0")
    target = np.asarray(target, np.float64)
    if target.shape != (3,) or not np.isfinite(target).all():
        raise ConfigError(f"target {target!r} is not a point", remedy="give three finite numbers")
    direction = unit(direction)
    quaternion = facing(direction)
    if turn_rad:
        turned = rotation_matrices(quaternion) @ _turns((0.0, 0.0, 1.0), np.array([turn_rad]))
        quaternion = quaternions_of(turned)[0]
    contact_m = first_contact(indenter, quaternion, target, direction, surface)
    travel = contact_m + np.concatenate([[-clearance_m], depth_m * np.arange(1, steps + 1) / steps])
    path = np.empty((steps + 1, 7))
    path[:, :3] = target + travel[:, None] * direction
    path[:, 3:] = quaternion
    return path, contact_m


_FACES_DOWN = -0.3  # z of the normal of the pad; steeper skin belongs to a side
_EDGE = -1e-9  # share of a triangle beyond its edge that is rounding


def pad_point(surface: OuterSurface, x_m: float, y_m: float) -> tuple[Floats, Floats]:
    """Point of the pad at (x, y) and outward unit normal there, both shape (3,), sensor frame.

    Both are interpolated in the triangle over (x, y), as those of `sample_targets` are.

    Raises:
        ConfigError: There is no pad; names the nearest place of it.
    """
    smooth, faces = node_normals(surface.nodes, surface.faces), surface.triangles
    beside = surface.nodes[faces][:, :, :2] - (x_m, y_m)
    ahead, behind = np.roll(beside, -1, axis=1), np.roll(beside, -2, axis=1)
    weights = ahead[..., 0] * behind[..., 1] - ahead[..., 1] * behind[..., 0]
    area = weights.sum(axis=1)  # twice that of the triangle seen from above; below 0: it faces down
    over = np.flatnonzero((area < 0.0) & (weights <= _EDGE * area[:, None]).all(axis=1))
    shares = (weights[over] / area[over, None])[..., None]
    points = (shares * surface.nodes[faces[over]]).sum(axis=1)
    normals = (shares * smooth[faces[over]]).sum(axis=1)
    if len(over):
        lowest = int(points[:, 2].argmin())
        normal = unit(normals[lowest])
        if points[lowest, 2] < 0.0 and normal[2] < _FACES_DOWN:
            return points[lowest], normal
    on_skin = surface.used
    pad = surface.nodes[on_skin[smooth[on_skin, 2] < _FACES_DOWN]] * 1e3
    nearest = pad[np.hypot(pad[:, 0] - x_m * 1e3, pad[:, 1] - y_m * 1e3).argmin()]
    raise ConfigError(
        f"there is no pad at x = {x_m * 1e3:g} mm, y = {y_m * 1e3:g} mm",
        remedy=f"the nearest place of the pad is about x = {nearest[0]:.1f} mm, "
        f"y = {nearest[1]:.1f} mm",
    )
