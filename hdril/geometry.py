"""Rigid poses. Quaternions are (x, y, z, w), as in PyBullet and SciPy.

The algebra is written out on plain floats, because an episode composes thousands of poses one by one: with SciPy's
``Rotation``, at 60 microseconds each, they would take a tenth of the simulation's time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

IDENTITY_QUATERNION = (0.0, 0.0, 0.0, 1.0)
POSE_AXES = ("x", "y", "z", "qx", "qy", "qz", "qw")

Quaternion = Sequence[float]


def about_z(angle: float) -> tuple[float, float, float, float]:
    """The quaternion of a turn by ``angle``, rad, about z."""
    return 0.0, 0.0, math.sin(0.5 * angle), math.cos(0.5 * angle)


def _vector(value: ArrayLike, size: int, what: str) -> NDArray[np.float64]:
    array = np.array(value, dtype=np.float64)
    # Plain floats: np.isfinite(...).all() takes four times as long on so few, and an episode makes thousands of poses.
    if array.shape != (size,) or not all(map(math.isfinite, array.tolist())):
        raise ValueError(f"{what} must be {size} finite numbers, got {value!r}")
    array.setflags(write=False)
    return array


def quaternion_product(a: Quaternion, b: Quaternion) -> tuple[float, float, float, float]:
    """x, y, z and w of a b."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _rotate(q: Quaternion, v: Sequence[float]) -> tuple[float, float, float]:
    """v + 2 w (u x v) + 2 u x (u x v) for q = (u, w)."""
    x, y, z, w = q
    vx, vy, vz = v
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


@dataclass(frozen=True, eq=False, init=False)
class Pose:
    """A rigid transform: a frame's position (3,) in m and its orientation (4,), xyzw, in a parent frame.

    Raises:
        ValueError: a wrong length, a number that is not finite, or a quaternion of length 0.
    """

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]

    def __init__(self, position: ArrayLike, quaternion: ArrayLike = IDENTITY_QUATERNION) -> None:
        unscaled = _vector(quaternion, 4, "a quaternion")
        norm = math.sqrt(unscaled @ unscaled)
        if norm < 1e-6:
            raise ValueError(f"a quaternion must not be zero, got {unscaled.tolist()}")
        unit = unscaled / norm
        unit.setflags(write=False)
        object.__setattr__(self, "position", _vector(position, 3, "a position"))
        object.__setattr__(self, "quaternion", unit)

    def __matmul__(self, other: Pose) -> Pose:
        """Compose: ``world_T_a @ a_T_b`` is ``world_T_b``."""
        rotation = self.quaternion.tolist()
        offset = np.array(_rotate(rotation, other.position.tolist()))
        return Pose(self.position + offset, quaternion_product(rotation, other.quaternion.tolist()))

    def inverse(self) -> Pose:
        x, y, z, w = self.quaternion.tolist()
        conjugate = (-x, -y, -z, w)
        return Pose(-np.array(_rotate(conjugate, self.position.tolist())), conjugate)

    def translated(self, offset: ArrayLike) -> Pose:
        """This pose moved by ``offset`` (3,), m, along the parent frame's axes."""
        return Pose(self.position + np.asarray(offset, dtype=np.float64), self.quaternion)

    def aligned_to(self, reference: ArrayLike) -> Pose:
        """The same pose with the sign of its quaternion chosen for a non-negative product with ``reference`` (4,)."""
        return self if self.quaternion @ np.asarray(reference) >= 0.0 else Pose(self.position, -self.quaternion)

    def rotation_matrix(self) -> NDArray[np.float64]:
        """(3, 3): the columns are this frame's axes in the parent frame."""
        x, y, z, w = self.quaternion.tolist()
        return np.array(
            (
                (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
                (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
                (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
            )
        )

    @property
    def heading(self) -> float:
        """Angle of this frame's x axis about the parent's z axis, rad."""
        axis = self.rotation_matrix()[:, 0]
        return math.atan2(axis[1], axis[0])

    def as_vector(self) -> NDArray[np.float64]:
        """(7,): x, y, z, qx, qy, qz, qw."""
        return np.concatenate([self.position, self.quaternion])

    @staticmethod
    def from_vector(vector: ArrayLike) -> Pose:
        vector = _vector(vector, 7, "a pose")
        return Pose(vector[:3], vector[3:])


def interpolate(start: Pose, end: Pose, fraction: float) -> Pose:
    """Straight line in position, great circle in rotation; ``fraction`` 0 gives ``start``, 1 gives ``end``."""
    position = (1.0 - fraction) * start.position + fraction * end.position
    goal = end.aligned_to(start.quaternion).quaternion
    half = 0.5 * float(geodesic_distance(start.quaternion, goal))
    if half < 1e-6:  # sin(half) is too small to divide by
        quaternion = (1.0 - fraction) * start.quaternion + fraction * goal
    else:
        quaternion = (
            math.sin((1.0 - fraction) * half) * start.quaternion + math.sin(fraction * half) * goal
        ) / math.sin(half)
    return Pose(position, quaternion)


def geodesic_distance(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Angle between orientations, rad, in [0, pi], for (..., 4) arrays.

    4 arctan2(|a - b|, |a + b|), with the sign of b that is nearer to a. The arctangent is accurate at small angles, where
    2 arccos(|a . b|) loses half of the digits.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    minus, plus = np.square(a - b).sum(-1), np.square(a + b).sum(-1)
    return 4.0 * np.arctan2(np.sqrt(np.minimum(minus, plus)), np.sqrt(np.maximum(minus, plus)))
