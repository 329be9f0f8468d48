"""The waypoints of a primitive that nothing disturbs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hdril.tasks.primitives import Noise, Plan, Primitive, Scene


def waypoints(primitive: Primitive, scene: Scene, noise: Noise | None = None, seed: int = 0) -> NDArray[np.float64]:
    """All waypoints (frames, 16) of a primitive from ``scene``; without noise unless given."""
    plan = Plan(primitive, scene, noise or Noise(0.0), np.random.default_rng(seed))
    return np.stack([plan.next() for _ in range(primitive.frames)])
