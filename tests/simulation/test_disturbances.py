"""What an event does to world, motors and hands: how strongly, for how long, and to nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.simulation.actions import hand_slice, openings
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.disturbances import Disturbances
from hdril.simulation.robots import SIDES
from hdril.simulation.sensor import Sensor, SensorSpec
from hdril.simulation.world import ROBOT, Physics, World
from hdril.tasks.events import EVENT_KINDS, Event

BLOCK = BodySpec("block", (Box((0.2, 0.2, 0.2), (0.0, 0.0, 0.1)),), mass=2.0)
OTHER = BodySpec("other", (Box((0.2, 0.2, 0.2), (0.0, 0.0, 0.1)),), mass=2.0)
SHELF = BodySpec("shelf", (Box((0.2, 0.2, 0.2), (0.0, 0.0, 0.1)),))


@pytest.fixture
def world() -> Iterator[World]:
    """Two blocks that float, and a shelf."""
    made = World(Physics(gravity=0.0))
    with closing(made):
        for i, body in enumerate((BLOCK, OTHER, SHELF)):
            made.add_body(body, Pose((float(i), 0.0, 1.0)))
        yield made


@pytest.fixture
def env() -> Iterator[BimanualEnv]:
    made = BimanualEnv("table_lift")
    with closing(made):
        made.reset(seed=0)
        yield made


def test_a_push_gives_its_impulse_in_half_a_control_period_to_its_body_alone(world: World) -> None:
    impulse, steps = np.array((0.6, -0.8, 0.3)), world.physics.substeps // 2
    Disturbances(world, None, None).push("block", impulse)  # type: ignore[arg-type]
    world.step(steps // 2)
    halfway = BLOCK.mass * world.velocity("block")[0]
    world.step(steps - steps // 2)
    given = BLOCK.mass * world.velocity("block")[0]
    world.step(world.physics.substeps)
    np.testing.assert_allclose(halfway, impulse / 2, rtol=0.01)
    np.testing.assert_allclose(given, impulse, rtol=0.01)
    np.testing.assert_allclose(BLOCK.mass * world.velocity("block")[0], impulse, rtol=0.02)
    assert world.velocity("block")[1] == pytest.approx(np.zeros(3), abs=1e-9), "it acts at the centre of mass"
    assert not world.velocity("other")[0].any()


def test_a_slide_moves_its_body_at_constant_speed_and_then_stops(world: World) -> None:
    offset, frames = np.array((0.04, -0.02, 0.0)), 8
    before = world.pose("shelf").position.copy()
    Disturbances(world, None, None).slide("shelf", offset, frames)  # type: ignore[arg-type]
    for done in range(1, frames + 4):
        world.step(world.physics.substeps)
        expected = before + offset * min(1.0, done / frames)
        np.testing.assert_allclose(world.pose("shelf").position, expected, atol=1e-9)


@pytest.mark.parametrize("frames", [2, 5])
def test_a_stopped_motor_holds_its_joint_for_the_frames_that_are_asked_for(env: BimanualEnv, frames: int) -> None:
    joint = env.robot_spec.arms["left"].joints[0]
    others = env.robot_spec.arms["right"].joints[:1]

    def angles() -> np.ndarray:
        return env.world.joint_positions(ROBOT, env.world.joint_indices(ROBOT, (joint, *others)))

    action = env.controller.observe()
    for side in SIDES:
        action[hand_slice(side)][1] += 0.12
    before = angles()
    env.controller.stop_motor(joint, frames)
    for _ in range(frames):
        env.step(action)
        assert abs(angles()[0] - before[0]) < 0.01
    assert abs(angles()[1] - before[1]) > 0.03, "the other arm goes where it is sent"
    env.step(action)
    assert abs(angles()[0] - before[0]) > 0.02


@pytest.mark.parametrize("frames", [2, 5])
def test_a_hand_stays_open_for_the_frames_that_are_asked_for(env: BimanualEnv, frames: int) -> None:
    action = env.controller.observe()
    for side in SIDES:
        action[hand_slice(side)][7] = 0.0
    env.controller.force_open("left", frames)
    seen = []
    for _ in range(frames + 3):
        observation, *_ = env.step(action)
        seen.append(openings(observation["agent_pos"][None])[0])
    left, right = np.array(seen).T
    assert left[:frames].min() > 0.9
    assert left[-1] < 0.1
    assert left[frames] < 0.9, "it closes at the next frame"
    assert right[1:].max() < 0.1


@pytest.mark.parametrize(
    ("kind", "expected"), [("freeze", [0, 0, 0, 0, 0, 0, 0, 7, 8]), ("repeat", [0, 1, 1, 1, 4, 4, 4, 7, 8])]
)
def test_what_a_blind_sensor_shows(kind: str, expected: list[int]) -> None:
    """The number of the frame whose poses are shown at each frame; the event takes frames 1 to 6."""
    sensor = Sensor(SensorSpec(), seed=0)
    door, shown = Disturbances(None, None, sensor), []  # type: ignore[arg-type]
    for frame in range(len(expected)):
        if frame == 1:
            EVENT_KINDS[kind].begin(door, Event("e", kind, 1, 6, ""))
        shown.append(round(float(sensor.observe([Pose((float(frame), 0.0, 0.0))])[0])))
    assert shown == expected
