"""Poses form a group, and agree with SciPy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose, geodesic_distance, interpolate


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(rng.normal(size=3), rng.normal(size=4))


def assert_same(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.position, b.position, atol=1e-12)
    assert geodesic_distance(a.quaternion, b.quaternion) < 1e-7


@pytest.fixture(params=range(20))
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


def test_group_axioms(rng: np.random.Generator) -> None:
    a, b, c = (random_pose(rng) for _ in range(3))
    identity = Pose((0, 0, 0))
    assert_same((a @ b) @ c, a @ (b @ c))
    assert_same(a @ identity, a)
    assert_same(a @ a.inverse(), identity)
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())


def test_agrees_with_scipy(rng: np.random.Generator) -> None:
    a, b = random_pose(rng), random_pose(rng)
    ra, rb = Rotation.from_quat(a.quaternion), Rotation.from_quat(b.quaternion)
    np.testing.assert_allclose((a @ b).rotation_matrix(), (ra * rb).as_matrix(), atol=1e-12)
    np.testing.assert_allclose((a @ b).position, a.position + ra.apply(b.position), atol=1e-12)
    assert geodesic_distance(a.quaternion, b.quaternion) == pytest.approx((ra.inv() * rb).magnitude(), abs=1e-9)


def test_interpolation_moves_at_constant_rate(rng: np.random.Generator) -> None:
    a, b = random_pose(rng), random_pose(rng)
    assert_same(interpolate(a, b, 0.0), a)
    assert_same(interpolate(a, b, 1.0), b)
    whole = geodesic_distance(a.quaternion, b.quaternion)
    for fraction in (0.1, 0.5, 0.8):
        part = geodesic_distance(a.quaternion, interpolate(a, b, fraction).quaternion)
        assert part == pytest.approx(fraction * whole, abs=1e-9)


def test_interpolation_between_equal_orientations() -> None:
    a = Pose((0, 0, 0), (0.1, 0.2, 0.3, 0.9))
    assert_same(interpolate(a, a.translated((1, 0, 0)), 0.5), a.translated((0.5, 0, 0)))


def test_small_angles_keep_their_digits() -> None:
    tiny = Rotation.from_rotvec([1e-9, 0, 0]).as_quat()
    assert geodesic_distance((0, 0, 0, 1), tiny) == pytest.approx(1e-9, rel=1e-6)


@pytest.mark.parametrize("bad", [((0, 0, np.nan), (0, 0, 0, 1)), ((0, 0, 0), (0, 0, 0, 0)), ((0, 0), (0, 0, 0, 1))])
def test_refuses_what_is_no_pose(bad: tuple) -> None:
    with pytest.raises(ValueError, match=r"quaternion|position"):
        Pose(*bad)
