"""Errors of an episode against a demonstration."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from hdril.evaluation.metrics import dtw_distance, trajectory_error
from hdril.geometry import Pose
from hdril.simulation.actions import HandCommand, join_action
from hdril.simulation.robots import SIDES

Path3 = NDArray[np.float64]


def line(frames: int) -> Path3:
    """One metre along x."""
    path = np.zeros((frames, 3))
    path[:, 0] = np.linspace(0.0, 1.0, frames)
    return path


def walk(rng: np.random.Generator, frames: int) -> Path3:
    return rng.normal(size=(frames, 3)).cumsum(0)


def states(left: Path3, right: Path3) -> NDArray[np.float64]:
    """States (T, 16) with the hands on two paths, upright."""
    hands = (dict(zip(SIDES, points, strict=True)) for points in zip(left, right, strict=True))
    return np.stack([join_action({side: HandCommand(Pose(at), 0.0) for side, at in hand.items()}) for hand in hands])


def optimal_path(a: Path3, b: Path3) -> list[tuple[int, int]]:
    """By the recurrence S_ij = d_ij + min(S_i-1,j-1, S_i-1,j, S_i,j-1), in plain Python."""
    best: dict[tuple[int, int], tuple[float, list[tuple[int, int]]]] = {}
    for i in range(len(a)):
        for j in range(len(b)):
            before = [best[k] for k in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if k in best] or [(0.0, [])]
            total, path = min(before, key=lambda entry: entry[0])
            best[i, j] = total + float(np.linalg.norm(a[i] - b[j])), [*path, (i, j)]
    return best[len(a) - 1, len(b) - 1][1]


@pytest.mark.parametrize("frames", [10, 70, 700])
def test_dtw_of_an_offset_across_the_path_is_the_offset_at_any_length(frames: int) -> None:
    moved = line(frames) + np.array([0.0, 0.006, 0.008])
    assert dtw_distance(moved, line(frames)) == pytest.approx(0.01, rel=1e-9)


@pytest.mark.parametrize(("first", "second"), [(9, 9), (12, 30), (31, 17), (1, 6)])
def test_dtw_is_the_mean_distance_along_the_optimal_path(first: int, second: int) -> None:
    rng = np.random.default_rng(first)
    a, b = walk(rng, first), walk(rng, second)
    distances = [np.linalg.norm(a[i] - b[j]) for i, j in optimal_path(a, b)]
    assert dtw_distance(a, b) == pytest.approx(np.mean(distances), rel=1e-9)


def test_dtw_takes_numbers_of_any_precision_and_memory_layout() -> None:
    a, b = (np.round(100 * walk(np.random.default_rng(seed), 20)) for seed in range(2))
    expected = dtw_distance(a, b)
    for kind in (np.float32, np.int64):
        assert dtw_distance(a.astype(kind), b) == dtw_distance(a, b.astype(kind)) == expected
    assert dtw_distance(np.asfortranarray(a), b) == dtw_distance(a, np.asfortranarray(b)) == expected


def test_dtw_forgives_a_delay() -> None:
    late = np.concatenate([line(50)[:1].repeat(8, 0), line(50)[:20], line(50)[19:20].repeat(5, 0), line(50)[20:]])
    assert dtw_distance(late, line(50)) == pytest.approx(0.0, abs=1e-12)


def test_dtw_is_symmetric_and_at_most_the_frame_by_frame_error() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        a, b = walk(rng, 25), walk(rng, 25)
        assert dtw_distance(a, b) == pytest.approx(dtw_distance(b, a), rel=1e-9)
        assert dtw_distance(a, b) <= np.linalg.norm(a - b, axis=1).mean() + 1e-12


def test_each_hand_counts_for_half() -> None:
    error = trajectory_error(states(line(30) + np.array([0, 0.02, 0]), line(30)), states(line(30), line(30)))
    np.testing.assert_allclose(error.position, 0.01)
    assert error.dtw == pytest.approx(0.01)
    np.testing.assert_array_equal(error.angle, 0.0)


def test_hands_are_warped_apart() -> None:
    """One hand is late and the other is not: for warping of both at once one of them is wrong at every step."""
    late = np.concatenate([line(40)[:1].repeat(10, 0), line(40)])
    early = np.concatenate([line(40), line(40)[-1:].repeat(10, 0)])
    error = trajectory_error(states(late, early), states(early, early))
    assert error.dtw == pytest.approx(0.0, abs=1e-12)
    assert error.position.mean() > 0.05


def test_angle_is_the_geodesic_distance_whatever_the_position() -> None:
    turned = states(line(50) + 1.0, line(50))
    turned[:, 3:7] = [np.sin(0.05), 0, 0, np.cos(0.05)]
    error = trajectory_error(turned, states(line(50), line(50)))
    np.testing.assert_allclose(error.angle, 0.05)  # one hand of two is turned by 0.1 rad


@pytest.mark.parametrize(("ours", "theirs"), [(20, 30), (30, 20)])
def test_frames_beyond_the_shorter_count_for_warping_alone(ours: int, theirs: int) -> None:
    straight = [np.tile(line(20)[:1], (frames, 1)) for frames in (ours, theirs)]
    straight[0][20:] += [0.3, 0, 0]
    straight[1][20:] += [0.3, 0, 0]
    error = trajectory_error(*(states(path, path) for path in straight))
    assert error.position.shape == error.angle.shape == (20,)
    assert error.position.max() == 0.0
    assert error.dtw > 0.02
