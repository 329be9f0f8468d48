"""The description of a two-armed robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import Pose

SIDES: tuple[str, ...] = ("left", "right")
OTHER: dict[str, str] = dict(zip(SIDES, reversed(SIDES), strict=True))
"""The other side."""
SIGN: dict[str, float] = dict(zip(SIDES, (1.0, -1.0), strict=True))
"""The sign of the y axis on each side."""


@dataclass(frozen=True)
class GripperSpec:
    """A parallel gripper: finger joints and where they are when closed and open, m, in the same order."""

    joints: tuple[str, ...]
    closed: tuple[float, ...]
    opened: tuple[float, ...]
    pads: tuple[str, ...]
    """Links that touch what is held."""

    def targets(self, opening: float) -> NDArray[np.float64]:
        """Finger positions for an opening from 0 (closed) to 1."""
        closed, opened = np.array(self.closed), np.array(self.opened)
        return closed + min(max(opening, 0.0), 1.0) * (opened - closed)

    def opening(self, positions: NDArray[np.float64]) -> float:
        """The inverse of :meth:`targets`, averaged over the fingers."""
        closed, opened = np.array(self.closed), np.array(self.opened)
        return min(max(float(((positions - closed) / (opened - closed)).mean()), 0.0), 1.0)


@dataclass(frozen=True)
class ArmSpec:
    """One arm: the joints from shoulder to wrist, its tool frame, its gripper, and the posture it prefers (rad)."""

    joints: tuple[str, ...]
    tool: str
    gripper: GripperSpec
    posture: tuple[float, ...]


@dataclass(frozen=True)
class Actuation:
    """The settings of the drives.

    ``efforts`` replaces the URDF's limits (Nm or N), joint by joint: a departure from the model, to be justified where
    it is set. ``arm_gain`` and ``finger_gain`` are PyBullet's dimensionless position gains. ``finger_gear_force``, N, is
    the largest force of the gear between the two fingers of a hand. ``velocities`` are the arm joints' speed limits, rad/s:
    targets move no faster. ``pad_torsion`` is PyBullet's spinning friction, m: the lever arm of friction about a
    contact's normal, which point contacts lack.
    """

    efforts: dict[str, float]
    arm_gain: float = 0.3
    finger_gain: float = 0.3
    finger_gear_force: float = 500.0
    pad_friction: float = 1.0
    pad_torsion: float = 0.0
    velocities: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RobotSpec:
    """A robot: where its model is, how it stands in the world, its arms by side, and its drives."""

    name: str
    urdf: Callable[[bool], Path]
    """Path of the URDF to load; the argument asks for the visual meshes."""
    source: Callable[[], Path]
    """Path of the manufacturer's URDF: kinematics and pictures."""
    base: Pose
    arms: dict[str, ArmSpec]
    actuation: Actuation
    ignored_collisions: Callable[[tuple[str, ...]], list[tuple[str, str]]]
    """Pairs of links that may overlap, given all links."""
    base_link: str = "base"
    hand_reference: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)
    """Observed hand orientations have a non-negative product with this quaternion, so that their sign does not jump."""

    def __post_init__(self) -> None:
        if tuple(self.arms) != SIDES:
            raise ValueError(f"{self.name} must have the arms {SIDES} in this order, got {tuple(self.arms)}")
