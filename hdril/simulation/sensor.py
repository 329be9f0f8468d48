"""What is observed of the objects: their poses with noise, late, or not at all for a while."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import IDENTITY_QUATERNION, Pose, quaternion_product


@dataclass(frozen=True)
class SensorSpec:
    """How well objects are seen: standard deviations of position (m) and rotation (rad) at every frame, and delay in frames.

    The hands are measured by the robot's own encoders, without noise or delay.
    """

    position_noise: float = 0.0
    rotation_noise: float = 0.0
    delay: int = 0


class Sensor:
    """Observes the poses of objects, one frame after the other."""

    def __init__(self, spec: SensorSpec, seed: int) -> None:
        self._spec = spec
        self._rng = np.random.default_rng([seed, 2])  # streams 0 and 1 are the scene's and the expert's
        self._noise: Iterator[list[list[float]]] | None = None
        self._seen: deque[NDArray[np.float64]] = deque(maxlen=spec.delay + 1)
        self._every = 1
        self._disturbed = 0
        self._shown: NDArray[np.float64] | None = None

    def disturb(self, frames: int, every: int | None = None) -> None:
        """Show nothing new for ``frames`` frames, or only each ``every``-th."""
        self._disturbed, self._every = frames, every or frames + 1

    def observe(self, poses: list[Pose]) -> NDArray[np.float64]:
        """(7 per object): poses as they are seen at this frame; quaternions with w >= 0."""
        # Noise is drawn at every frame, shown or not, so that an episode and its control draw the same.
        self._seen.append(np.array(self._blurred(poses)))
        fresh = True
        if self._disturbed:
            fresh = self._disturbed % self._every == 0
            self._disturbed -= 1
        if fresh or self._shown is None:
            self._shown = self._seen[0]
        return self._shown

    def _blurred(self, poses: list[Pose]) -> list[float]:
        """The numbers of the poses, each moved and turned by noise."""
        if self._noise is None:
            self._noise = self._draw(len(poses))
        numbers: list[float] = []
        for pose, (dx, dy, dz, *turn) in zip(poses, next(self._noise), strict=True):
            x, y, z = pose.position.tolist()
            qx, qy, qz, qw = quaternion_product(pose.quaternion.tolist(), turn)
            sign = -1.0 if qw < 0.0 else 1.0
            numbers += (x + dx, y + dy, z + dz, sign * qx, sign * qy, sign * qz, sign * qw)
        return numbers

    def _draw(self, objects: int) -> Iterator[list[list[float]]]:
        """For each frame a row for each object: an offset, m, and the quaternion of a turn about a random axis."""
        spec, frames = self._spec, 64  # at once: one by one they would take a hundredth of an episode's time
        if not spec.position_noise and not spec.rotation_noise:
            yield from itertools.repeat([[0.0, 0.0, 0.0, *IDENTITY_QUATERNION]] * objects)
        while True:
            draws = self._rng.normal(size=(frames, objects, 7))
            axes, half = draws[..., 3:6], 0.5 * spec.rotation_noise * draws[..., 6:]
            axes /= np.maximum(np.linalg.norm(axes, axis=-1, keepdims=True), 1e-9)
            offsets = spec.position_noise * draws[..., :3]
            yield from np.concatenate([offsets, np.sin(half) * axes, np.cos(half)], axis=-1).tolist()
