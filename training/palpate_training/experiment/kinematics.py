"""The indenter's tip from joint angles and back, by Pinocchio, from a user's URDF.

The robot frame is the root link of the URDF. Only joints with one number each (revolute with
limits, prismatic) are taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError
from palpate.process import require
from palpate.rigid import Floats, Transform, quaternions_of

ACCURACY_M = 0.01e-3
"""Paper, "Experimental testing procedure": a trajectory is kept at 0.01 mm or better."""

ANGLE_ACCURACY_RAD = 1.0e-4
"""Ours; 0.01 mm at 100 mm from the tip."""

LIMIT_MARGIN = 1.0e-3
"""By how much a logged joint may overrun its limit [rad or m]: encoders of a joint at its stop."""

_ITERATIONS = 100
_DAMPING = 1.0e-3  # [1]; keeps steps bounded at singular poses, error at convergence stays 0
_STEP = 0.3  # [rad]; the linearisation is no good beyond
_RESTARTS = 30


@dataclass(frozen=True, slots=True)
class JointSolution:
    """Joints that bring the tip to poses.

    Attributes:
        joints: Within the limits [rad or m], shape (T, n).
        position_error_m: Distance of the tip from each pose [m], shape (T,).
        angle_error_rad: Angle to each pose [rad], shape (T,).
    """

    joints: Floats
    position_error_m: Floats
    angle_error_rad: Floats

    @property
    def reached(self) -> bool:
        """Whether every pose is met to the accuracy of the paper."""
        return bool(
            (self.position_error_m <= ACCURACY_M).all()
            and (self.angle_error_rad <= ANGLE_ACCURACY_RAD).all()
        )


class ArmKinematics:
    """Kinematics of an arm with a tool.

    Attributes:
        name: File it came from.
        joint_names: In the order of the columns of ``joints``.
        lower: Limits [rad or m], shape (n,).
        upper: Limits [rad or m], shape (n,).
    """

    def __init__(self, model: Any, frame: int, tool: Transform, *, name: str) -> None:
        self._pin: ModuleType = require("pinocchio", extra="training")
        self._model, self._data, self._frame = model, model.createData(), frame
        self._tool = self._pin.SE3(tool.rotation, tool.translation)
        self.name = name
        self.joint_names: tuple[str, ...] = tuple(str(n) for n in list(model.names)[1:])
        self.lower: Floats = np.array(model.lowerPositionLimit, np.float64)
        self.upper: Floats = np.array(model.upperPositionLimit, np.float64)

    @classmethod
    def from_urdf(cls, path: Path, tip_frame: str, tool_transform: Transform | None = None) -> Self:
        """Read a URDF.

        Args:
            path: The file.
            tip_frame: Link or joint that carries the tool, e.g. ``flange``.
            tool_transform: Pose of the tip in that frame; None = the frame itself.

        Raises:
            ConfigError: The file cannot be read, is no URDF, lacks the frame, or has joints
                without limits.
            MissingExtraError: Pinocchio is not installed.
        """
        pin = require("pinocchio", extra="training")
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path} cannot be read: {error}", remedy="check the path") from error
        try:
            model = pin.buildModelFromXML(text)
        except (ValueError, RuntimeError) as error:
            raise ConfigError(
                f"{path} is not a readable URDF: {error}",
                remedy="check it with check_urdf; expand xacro first",
            ) from error
        if model.nq != model.nv or model.nq != model.njoints - 1 or model.nq == 0:
            raise ConfigError(
                f"{path}: {model.njoints - 1} moving joints with {model.nq} numbers",
                remedy="give an arm whose joints are revolute with limits, or prismatic",
            )
        if not model.existFrame(tip_frame):
            known = ", ".join(str(frame.name) for frame in model.frames)
            raise ConfigError(
                f"{path} has no frame {tip_frame!r}", remedy=f"name one of its frames: {known}"
            )
        tool = Transform.identity() if tool_transform is None else tool_transform
        return cls(model, model.getFrameId(tip_frame), tool, name=str(path))

    def tip(self, joints: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Tip of the tool by forward kinematics, robot frame.

        Args:
            joints: Joint positions [rad or m], shape (T, n).

        Returns:
            Positions [m], shape (T, 3), and unit quaternions w x y z, shape (T, 4).

        Raises:
            ConfigError: Another number of joints, NaN, or outside the limits.
        """
        rows = self._checked(joints)
        positions, rotations = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
        for i, row in enumerate(rows):
            tip = self._tip(row)
            positions[i], rotations[i] = tip.translation, tip.rotation
        return positions, quaternions_of(rotations)

    def link_frames(self, joints: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Frames that move with each joint, robot frame.

        Args:
            joints: Joint positions [rad or m], shape (T, n).

        Returns:
            Origins [m], shape (T, n, 3), and rotations, shape (T, n, 3, 3).

        Raises:
            ConfigError: As `tip`.
        """
        rows = self._checked(joints)
        n = len(self.joint_names)
        origins, rotations = np.empty((len(rows), n, 3)), np.empty((len(rows), n, 3, 3))
        for i, row in enumerate(rows):
            self._pin.forwardKinematics(self._model, self._data, row)
            for j in range(n):
                placement = self._data.oMi[j + 1]
                origins[i, j], rotations[i, j] = placement.translation, placement.rotation
        return origins, rotations

    def solve(
        self, poses: Floats, *, start: npt.ArrayLike | None = None, seed: int = 0
    ) -> JointSolution:
        """Joints along a path of poses, by damped least squares within the limits.

        Each pose starts from the joints of the one before, so that the arm keeps its posture. Where
        a whole path is not reached, other postures at its first pose are tried, drawn by ``seed``;
        the best is returned, reached or not.

        Args:
            poses: Of the tip, robot frame, shape (T, 7), position [m] and quaternion w x y z.
            start: Where to start from [rad or m], shape (n,); None = the middle of the limits.
            seed: Of the other postures.

        Raises:
            ConfigError: Poses or start of another shape, or not finite.
        """
        poses = np.asarray(poses, np.float64)
        if poses.ndim != 2 or poses.shape[1:] != (7,) or not len(poses):
            raise ConfigError(f"poses have shape {poses.shape}", remedy="give shape (T, 7)")
        targets = [self._se3(pose, f"pose {i}") for i, pose in enumerate(poses)]
        random = np.random.default_rng(seed)
        middle = (self.lower + self.upper) / 2
        first = middle if start is None else self._checked(np.atleast_2d(start))[0]
        best: JointSolution | None = None
        for _ in range(1 + _RESTARTS):
            found = self._follow(targets, first)
            if found.reached:
                return found
            if best is None or found.position_error_m.max() < best.position_error_m.max():
                best = found
            first = random.uniform(self.lower, self.upper)
        assert best is not None  # the loop runs at least once
        return best

    def _follow(self, targets: list[Any], joints: Floats) -> JointSolution:
        rows = np.empty((len(targets), len(joints)))
        errors = np.empty((len(targets), 2))
        for i, target in enumerate(targets):
            joints = self._reach(target, joints)
            off = self._tip(joints).actInv(target)
            rows[i] = joints
            errors[i] = (
                np.linalg.norm(off.translation),
                np.linalg.norm(self._pin.log3(off.rotation)),
            )
            if i == 0 and errors[0, 0] > 100 * ACCURACY_M:
                # Out of reach: the rest of the path is not solved.
                rows[:], errors[:] = rows[0], errors[0]
                break
        return JointSolution(rows, errors[:, 0], errors[:, 1])

    def _reach(self, target: Any, joints: Floats) -> Floats:
        pin = self._pin
        for _ in range(_ITERATIONS):
            tip = self._tip(joints)
            twist = pin.log6(tip.actInv(target)).vector
            if np.abs(twist[:3]).max() < 1e-8 and np.abs(twist[3:]).max() < 1e-8:
                break
            jacobian = self._jacobian(joints)
            # Joints at a limit that would move further are taken out, and the step is solved again.
            for _ in joints:
                gram = jacobian @ jacobian.T + _DAMPING**2 * np.eye(6)
                step = jacobian.T @ np.linalg.solve(gram, twist)
                stuck = ((joints <= self.lower) & (step < 0)) | (
                    (joints >= self.upper) & (step > 0)
                )
                if not stuck.any():
                    break
                jacobian[:, stuck] = 0.0
            step *= min(1.0, _STEP / max(float(np.abs(step).max()), 1e-12))
            joints = np.clip(joints + step, self.lower, self.upper)
        return joints

    def _jacobian(self, joints: Floats) -> Floats:
        """Of the tip, in its own axes, shape (6, n)."""
        of_frame = self._pin.computeFrameJacobian(
            self._model, self._data, joints, self._frame, self._pin.ReferenceFrame.LOCAL
        )
        return np.array(self._tool.actionInverse @ of_frame)

    def _tip(self, joints: Floats) -> Any:
        self._pin.forwardKinematics(self._model, self._data, joints)
        return self._pin.updateFramePlacement(self._model, self._data, self._frame) * self._tool

    def _se3(self, pose: Floats, what: str) -> Any:
        transform = Transform.from_pose(pose, what)
        return self._pin.SE3(transform.rotation, transform.translation)

    def _checked(self, joints: npt.ArrayLike) -> Floats:
        rows = np.asarray(joints, np.float64)
        n = len(self.joint_names)
        if rows.ndim != 2 or rows.shape[1] != n:
            raise ConfigError(
                f"joints have shape {rows.shape}, {self.name} has {n} joints",
                remedy=f"give shape (T, {n}) in the order {', '.join(self.joint_names)}",
            )
        bad = np.argwhere(~np.isfinite(rows))
        if len(bad):
            row, column = bad[0]
            raise ConfigError(
                f"{self.joint_names[column]} is {rows[row, column]} in row {row}",
                remedy="leave such rows out of the joint log",
            )
        out = np.argwhere((rows < self.lower - LIMIT_MARGIN) | (rows > self.upper + LIMIT_MARGIN))
        if len(out):
            row, column = out[0]
            raise ConfigError(
                f"{self.joint_names[column]} is {rows[row, column]:.4f} in row {row}, outside"
                f" {self.lower[column]:.4f} to {self.upper[column]:.4f} of {self.name}",
                remedy="check unit (rad, m), order of the joints, and that the URDF is the arm",
            )
        return rows
