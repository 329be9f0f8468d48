"""How hands move: paths, jerk, slip, forces, heights, of episodes made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hdril.evaluation.motion import jerk, motion, path_length, slip
from hdril.geometry import Pose
from tests.evaluation.synthetic import TASK, moved, trace

PERIOD = 0.1


def cubic(frames: int, rate: float) -> np.ndarray:
    """Positions (T, 2, 3) of two hands: the left along x with a constant third derivative, m/s³; the right at rest."""
    positions = np.zeros((frames, 2, 3))
    positions[:, 0, 0] = rate * (PERIOD * np.arange(frames)) ** 3 / 6.0
    return positions


def test_the_path_is_the_sum_of_both_hands_and_counts_the_way_back() -> None:
    positions = np.zeros((4, 2, 3))
    positions[:, 0] = [(0, 0, 0), (3, 4, 0), (3, 4, 0), (0, 0, 0)]
    positions[:, 1, 2] = [0, 1, 2, 3]
    assert path_length(positions) == pytest.approx(5.0 + 5.0 + 3.0)


def test_jerk_is_in_metres_per_cubic_second() -> None:
    """6 m/s³ in one hand of two: the root mean square is 6 / sqrt(2), at whatever rate the frames come."""
    assert jerk(cubic(9, 6.0), PERIOD) == pytest.approx(6.0 / np.sqrt(2.0))
    assert jerk(cubic(9, 6.0)[::2], 2.0 * PERIOD) == pytest.approx(6.0 / np.sqrt(2.0))
    assert jerk(cubic(3, 6.0), PERIOD) == 0.0
    steady = np.arange(6.0)[:, None, None] * np.ones((1, 2, 3))
    assert jerk(steady, PERIOD) == pytest.approx(0.0, abs=1e-9)


def carried(slips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A hand that moves and turns a body with it, while the body slides in the hand to ``slips`` (T,), m, along its own x."""
    angles = np.linspace(0.0, 1.0, len(slips))
    hands = np.zeros((len(slips), 2, 3))
    hands[:, 0] = np.stack([angles, 2.0 * angles, np.zeros_like(angles)], axis=1)
    turns = [Pose(hand, (0.0, 0.0, np.sin(a / 2), np.cos(a / 2))) for hand, a in zip(hands[:, 0], angles, strict=True)]
    poses = [turn @ Pose((0.3 + offset, 0.0, 0.0)) for turn, offset in zip(turns, slips, strict=True)]
    return hands, np.stack([pose.as_vector() for pose in poses])


def test_a_body_that_is_carried_and_turned_does_not_slip() -> None:
    hands, poses = carried(np.zeros(6))
    assert slip(hands, poses, np.ones((6, 2), np.bool_) & [True, False]) == pytest.approx(0.0, abs=1e-12)


def test_slip_is_what_the_body_moves_in_a_hand_that_holds_it() -> None:
    hands, poses = carried(np.array([0.0, 0.01, 0.03, 0.03, 0.02, 0.02]))
    held = np.zeros((6, 2), np.bool_)
    assert slip(hands, poses, held) == 0.0
    held[:, 0] = True
    assert slip(hands, poses, held) == pytest.approx(0.04)
    held[2] = False  # the way to row 2, and the one from it, are not held
    assert slip(hands, poses, held) == pytest.approx(0.02)


def test_heights_and_forces_are_peaks() -> None:
    episode = moved(moved(trace(), 3, (0.0, 0.0, -0.07), hand=0), 4, (0.0, 0.0, 0.05), hand=0)
    episode = replace(episode, peak_force=np.array([0.0, 3.0, 41.0, 2.0, 0.0, 0.0, 0.0]))
    told = motion(episode, TASK.observed, PERIOD)
    assert told.peak_height_difference_m == pytest.approx(0.07, abs=1e-6)
    assert told.peak_force_n == 41.0
    assert told.slip_m == 0.0
    assert told.path_length_m == pytest.approx(
        2 * 6 * 0.01 - 2 * 0.01 + np.hypot(0.01, 0.07) + np.hypot(0.01, 0.05), abs=1e-5
    )
