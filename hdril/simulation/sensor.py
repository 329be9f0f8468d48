"""What is observed of the objects: their poses with noise, late, or not at all for a while."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import IDENTITY_QUATERNION, Pose


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
        self._seen.append(
            np.concatenate([self._blur(pose).aligned_to(IDENTITY_QUATERNION).as_vector() for pose in poses])
        )
        fresh = True
        if self._disturbed:
            fresh = self._disturbed % self._every == 0
            self._disturbed -= 1
        if fresh or self._shown is None:
            self._shown = self._seen[0]
        return self._shown

    def _blur(self, pose: Pose) -> Pose:
        spec = self._spec
        if spec.position_noise:
            pose = pose.translated(self._rng.normal(scale=spec.position_noise, size=3))
        if spec.rotation_noise:
            x, y, z = self._rng.normal(size=3)
            axis = np.array((x, y, z)) / max(math.sqrt(x * x + y * y + z * z), 1e-9)
            half = 0.5 * float(self._rng.normal(scale=spec.rotation_noise))
            pose = pose @ Pose((0.0, 0.0, 0.0), (*(math.sin(half) * axis), math.cos(half)))
        return pose
