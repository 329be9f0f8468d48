"""What the sensor adds to the poses of objects: noise, delay, and frames at which nothing new is shown."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from hdril.geometry import Pose, geodesic_distance
from hdril.simulation.sensor import Sensor, SensorSpec

TURNED = Pose((0.5, -0.2, 0.1), (0.3, -0.5, 0.1, -0.8))
UPRIGHT = Pose((0.1, 0.7, 0.4))


def moved(frames: int) -> list[list[Pose]]:
    return [[Pose((float(frame), 0.0, 0.0))] for frame in range(frames)]


def observed(sensor: Sensor, scenes: list[list[Pose]]) -> NDArray[np.float64]:
    """(frames, objects, 7)"""
    return np.array([sensor.observe(poses) for poses in scenes]).reshape(len(scenes), -1, 7)


def test_without_noise_poses_are_as_they_are_but_for_the_sign_of_the_quaternion() -> None:
    seen = observed(Sensor(SensorSpec(), 0), [[TURNED, UPRIGHT]])[0]
    np.testing.assert_allclose(seen[0], [*TURNED.position, *-TURNED.quaternion], rtol=1e-15)
    np.testing.assert_array_equal(seen[1], UPRIGHT.as_vector())


def test_noise_has_the_spread_that_is_asked_for_about_every_axis() -> None:
    seen = observed(Sensor(SensorSpec(0.005, 0.03), 1), 4000 * [[TURNED, UPRIGHT]])
    poses = np.stack([TURNED.as_vector(), UPRIGHT.as_vector()])
    np.testing.assert_allclose(seen[..., :3].mean(0), poses[:, :3], atol=5e-4)
    np.testing.assert_allclose(seen[..., :3].std(0), 0.005, rtol=0.08)
    angles = geodesic_distance(seen[..., 3:], poses[None, :, 3:])
    np.testing.assert_allclose(np.sqrt(np.square(angles).mean(0)), 0.03, rtol=0.08)
    np.testing.assert_allclose(np.linalg.norm(seen[..., 3:], axis=-1), 1.0, rtol=1e-12)
    assert (seen[..., 6] >= 0.0).all()
    # About UPRIGHT, the vector part is half of the turn: the same in all directions.
    np.testing.assert_allclose(2.0 * seen[:, 1, 3:6].std(0), 0.03 / np.sqrt(3.0), rtol=0.1)


def test_the_seed_decides_the_noise_and_objects_have_noise_of_their_own() -> None:
    first, again, other = (
        observed(Sensor(SensorSpec(0.005, 0.03), seed), 3 * [[UPRIGHT, UPRIGHT]]) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-4
    assert np.abs(first[:, 0] - first[:, 1]).max() > 1e-4
    assert np.abs(first[0] - first[1]).max() > 1e-4


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_delay_shows_what_was_so_many_frames_ago(delay: int) -> None:
    seen = observed(Sensor(SensorSpec(delay=delay), 0), moved(6))[:, 0, 0]
    assert seen.tolist() == [max(0.0, frame - delay) for frame in range(6)]


def test_nothing_new_is_shown_for_the_frames_that_are_asked_for() -> None:
    sensor = Sensor(SensorSpec(), 0)
    before = observed(sensor, moved(3))[:, 0, 0].tolist()
    sensor.disturb(2)
    assert [*before, *observed(sensor, moved(6)[3:])[:, 0, 0].tolist()] == [0.0, 1.0, 2.0, 2.0, 2.0, 5.0]


def test_only_each_third_frame_is_shown() -> None:
    sensor = Sensor(SensorSpec(), 0)
    observed(sensor, moved(1))
    sensor.disturb(6, every=3)
    assert observed(sensor, moved(9)[1:])[:, 0, 0].tolist() == [1.0, 1.0, 1.0, 4.0, 4.0, 4.0, 7.0, 8.0]


def test_a_disturbance_draws_no_other_noise() -> None:
    plain, disturbed = (Sensor(SensorSpec(0.005, 0.03), 0) for _ in range(2))
    disturbed.disturb(3)
    scenes = 5 * [[UPRIGHT]]
    np.testing.assert_array_equal(observed(plain, scenes)[3:], observed(disturbed, scenes)[3:])
