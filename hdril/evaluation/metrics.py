"""How far an episode is from the demonstration of the same seed: position, angle, dynamic time warping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dtaidistance import dtw, dtw_ndim
from numpy.typing import NDArray

from hdril.geometry import geodesic_distance
from hdril.simulation.actions import hand_poses


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of executed hand poses against a demonstration, mean of both hands."""

    position: NDArray[np.float64]  # (T,), m, frame by frame
    angle: NDArray[np.float64]  # (T,), rad, frame by frame
    dtw: float
    """:func:`dtw_distance` of the hands' positions, m."""


def dtw_distance(path: NDArray[np.floating | np.integer], reference: NDArray[np.floating | np.integer]) -> float:
    """Mean distance along the optimal warping path of (T, D) and (T', D), in the unit of the arguments.

    D = 1 / |P*| sum_{(i, j) in P*} |x_i - y_j|, where P* is the warping path from (0, 0) to (T - 1, T' - 1) of least
    sum. Between paths of equal sum, the one that steps in both indices at once is taken.

    A constant offset across the direction of motion gives its length, 1 cm for 1 cm, whatever the number of frames. This does not
    hold for an offset along the motion: warping takes it for a delay, and only the two ends keep it, which weigh less in a
    longer episode.

    Warping as in Sakoe and Chiba (1978), "Dynamic programming algorithm optimization for spoken word recognition", with
    steps of weight 1. The paper of HDR-IL does not define its DTW distance; the two must not be compared.
    """
    # Not dtaidistance's warping_path_fast: it ignores inner_dist and minimises the sum of squares.
    sums = dtw_ndim.warping_paths_fast(
        np.ascontiguousarray(path, dtype=np.float64),
        np.ascontiguousarray(reference, dtype=np.float64),
        inner_dist="euclidean",
    )[1]
    return float(sums[-1, -1]) / len(dtw.best_path(sums))


def trajectory_error(state: NDArray[np.floating], reference: NDArray[np.floating]) -> TrajectoryError:
    """Compare states (T, 16) with (T', 16): frame by frame over the shorter of the two, by warping over all of both."""
    ours, theirs = hand_poses(state), hand_poses(reference)
    frames = min(len(ours), len(theirs))
    a, b = ours[:frames], theirs[:frames]
    return TrajectoryError(
        position=np.linalg.norm(a[..., :3] - b[..., :3], axis=-1).mean(1),
        angle=geodesic_distance(a[..., 3:], b[..., 3:]).mean(1),
        dtw=float(np.mean([dtw_distance(ours[:, hand, :3], theirs[:, hand, :3]) for hand in range(ours.shape[1])])),
    )
