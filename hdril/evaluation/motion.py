"""How the hands moved in an episode, whatever it came to: path, jerk, slip, forces, and the hands against each other.

The quantities are those that RoboEval reports beside success (arXiv:2507.00435). Two of them are other than there: slip is a
length here and not a count, and contact is a force and not a count of collisions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import Pose
from hdril.simulation.actions import hand_poses
from hdril.trace import Trace


@dataclass(frozen=True)
class Motion:
    """What an episode's motion was like."""

    path_length_m: float
    """Length of the paths of both hands together, m."""
    jerk_m_s3: float
    """Root mean square of the hands' jerk, m/s³."""
    slip_m: float
    """How far objects moved in the hands that held them, m."""
    peak_force_n: float
    """The largest force of the robot on one body at the end of a frame, N."""
    peak_height_difference_m: float
    """The largest difference between the heights of the two hands, m."""


def motion(trace: Trace, bodies: Iterable[str], period: float) -> Motion:
    """The motion of an episode.

    Args:
        trace: the episode.
        bodies: those that can slip.
        period: seconds between two frames.
    """
    hands = hand_poses(trace.state)[..., :3]
    heights = hands[..., 2]
    return Motion(
        path_length(hands),
        jerk(hands, period),
        sum(slip(hands, trace.poses[body], trace.held[body]) for body in bodies),
        float(trace.peak_force.max()),
        float(np.abs(heights[:, 0] - heights[:, 1]).max()),
    )


def path_length(positions: NDArray[np.float64]) -> float:
    """sum_t sum_h |x_h(t + 1) - x_h(t)| of positions x (T + 1, hands, 3), m."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=-1).sum())


def jerk(positions: NDArray[np.float64], period: float) -> float:
    """Root mean square over frames and hands of the third difference quotient of positions x (T + 1, hands, 3), m/s³.

    j(t) = (x(t + 3) - 3 x(t + 2) + 3 x(t + 1) - x(t)) / period³; its square is what the smoothest motion has least of, after
    Flash and Hogan (1985), "The coordination of arm movements", Journal of Neuroscience 5(7), 1688-1703. An episode of fewer
    than three frames has none: 0.
    """
    third = np.diff(positions, n=3, axis=0) / period**3
    return float(np.sqrt((third**2).sum(-1).mean())) if third.size else 0.0


def slip(hands: NDArray[np.float64], poses: NDArray[np.float64], held: NDArray[np.bool_]) -> float:
    """How far a body with poses B(t) (T + 1, 7) moved in the hands at positions x(t) (T + 1, hands, 3), m.

    sum over hands and over frames at whose start and end the hand holds the body (``held``, (T + 1, hands)) of
    |B(t + 1) B(t)^-1 x(t) - x(t + 1)|: B(t + 1) B(t)^-1 x(t) is where the point of the body that was in the hand is one frame
    later. A body that turns about the point where it is held does not slip.
    """
    total, frames = 0.0, [Pose.from_vector(pose) for pose in poses]
    for t, side in np.argwhere(held[:-1] & held[1:]):
        follows = frames[t + 1] @ frames[t].inverse() @ Pose(hands[t, side])
        total += float(np.linalg.norm(follows.position - hands[t + 1, side]))
    return total
