"""Rigid bodies made of boxes, as data, with their mass properties."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hdril.geometry import IDENTITY_QUATERNION, Pose

Vector3 = tuple[float, float, float]
Colour = tuple[float, float, float, float]


@dataclass(frozen=True)
class Box:
    """A solid box of a compound body: full edge lengths and centre (m), and orientation (xyzw), in the body's frame."""

    size: Vector3
    centre: Vector3
    colour: Colour = (0.72, 0.53, 0.36, 1.0)
    quaternion: tuple[float, float, float, float] = IDENTITY_QUATERNION


@dataclass(frozen=True)
class BodySpec:
    """A rigid body made of boxes of one density. ``mass`` 0 makes it immovable.

    ``anchored`` asks the solver for friction anchors, which stop a gripped body from creeping through the fingers.
    """

    name: str
    boxes: tuple[Box, ...]
    mass: float = 0.0
    friction: float = 0.8
    anchored: bool = True

    @property
    def centre_of_mass(self) -> NDArray[np.float64]:
        """(3,), m, body frame."""
        volumes = np.array([np.prod(box.size) for box in self.boxes])
        return (volumes[:, None] * np.array([box.centre for box in self.boxes])).sum(0) / volumes.sum()

    @property
    def inertia(self) -> NDArray[np.float64]:
        """(3, 3), kg m²: inertia tensor about the centre of mass, along the body's axes.

        Each box adds R diag(I_box) R^T, and by the parallel-axis theorem m (|r|² E - r r^T) for its centre at r.
        """
        volumes = np.array([np.prod(box.size) for box in self.boxes])
        masses = self.mass * volumes / volumes.sum()
        total = np.zeros((3, 3))
        for box, mass in zip(self.boxes, masses, strict=True):
            squared, arm = np.square(box.size), np.array(box.centre) - self.centre_of_mass
            turn = Pose((0.0, 0.0, 0.0), box.quaternion).rotation_matrix()
            own = turn @ np.diag((squared.sum() - squared) / 12.0) @ turn.T
            total += mass * (own + (arm @ arm) * np.eye(3) - np.outer(arm, arm))
        return total

    @property
    def inertial_frame(self) -> tuple[Pose, NDArray[np.float64]]:
        """The frame of the principal axes at the centre of mass, in the body's frame, and the moments (3,), kg m²."""
        tensor, com = self.inertia, self.centre_of_mass
        products = tensor - np.diag(np.diag(tensor))
        if np.abs(products).max() <= 1e-9 * tensor.max():
            # The body's axes are principal. Others may be too, where moments are equal: keep these.
            return Pose(com), np.diag(tensor)
        moments, axes = np.linalg.eigh(tensor)
        axes[:, 0] *= np.sign(np.linalg.det(axes))  # right-handed
        return Pose(com, Rotation.from_matrix(axes).as_quat()), moments
