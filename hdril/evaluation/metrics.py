"""How far a rollout is from the demonstration of the same seed (paper, Section 5: Euclidean, angular, DTW)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dtaidistance import dtw_ndim
from numpy.typing import NDArray

from hdril.geometry import geodesic_distance
from hdril.simulation.actions import hand_poses


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of executed hand poses against a demonstration, frame by frame, mean of both hands."""

    position: NDArray[np.float64]  # (T,), m
    angle: NDArray[np.float64]  # (T,), rad
    dtw: float
    """Dynamic time warping distance of both hands' positions, m, divided by the number of frames: the paper does not
    say how it normalises."""


def trajectory_error(state: NDArray[np.floating], reference: NDArray[np.floating]) -> TrajectoryError:
    """Compare (T, 16) with (T', 16): frame by frame over the shorter, by warping over both."""
    ours, theirs = hand_poses(state), hand_poses(reference)
    frames = min(len(ours), len(theirs))
    a, b = ours[:frames], theirs[:frames]
    distance = dtw_ndim.distance_fast(
        np.ascontiguousarray(ours[..., :3].reshape(len(ours), -1)),
        np.ascontiguousarray(theirs[..., :3].reshape(len(theirs), -1)),
    )
    return TrajectoryError(
        position=np.linalg.norm(a[..., :3] - b[..., :3], axis=-1).mean(1),
        angle=geodesic_distance(a[..., 3:], b[..., 3:]).mean(1),
        dtw=float(distance) / len(ours),
    )
