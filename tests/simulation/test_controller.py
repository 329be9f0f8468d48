"""The controller: what it tells the motors, on a world that only writes it down; and how real arms follow."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.simulation.actions import HandCommand, hand_poses, hand_slice
from hdril.simulation.controller import EndEffectorController
from hdril.simulation.inverse_kinematics import IKSettings
from hdril.simulation.kinematics import Chain
from hdril.simulation.robots import ROBOTS, SIDES, RobotSpec
from hdril.simulation.world import ROBOT, Physics, World


class Logbook:
    """A world in which every motor reaches its target at once. It logs targets and timesteps in order."""

    def __init__(self, robot: RobotSpec, physics: Physics) -> None:
        self.robot, self.physics = robot, physics
        self.positions: dict[int, float] = {}
        self.log: list[tuple[str, Any]] = []
        self.names: list[str] = []

    def joint_indices(self, body: str, joints: Sequence[str]) -> list[int]:
        assert body == ROBOT
        self.names += [joint for joint in joints if joint not in self.names]
        return [self.names.index(joint) for joint in joints]

    def reset_joints(self, body: str, joints: Sequence[str], positions: Sequence[float]) -> None:
        self.positions = dict(zip(self.joint_indices(body, joints), positions, strict=True))

    def drive(self, body, indices, positions, gains, forces) -> None:
        assert body == ROBOT
        self.positions |= zip(indices, positions, strict=True)
        self.log.append(("drive", (np.array(positions), list(gains), list(forces))))

    def step(self, count: int = 1) -> None:
        self.log.append(("step", count))

    def joint_positions(self, body: str, indices: Sequence[int]) -> np.ndarray:
        return np.array([self.positions[index] for index in indices])

    def link_pose(self, body: str, link: str) -> Pose:
        arm = next(arm for arm in self.robot.arms.values() if arm.tool == link)
        chain = Chain(self.robot.source(), self.robot.base_link, link)
        return self.robot.base @ chain.forward(self.joint_positions(body, self.joint_indices(body, arm.joints)))

    def drives(self) -> list[np.ndarray]:
        return [entry[0] for kind, entry in self.log if kind == "drive"]


def started(robot: RobotSpec, substeps: int = 24, settings: IKSettings | None = None):
    controller, world = EndEffectorController(robot, settings), Logbook(robot, Physics(substeps=substeps))
    controller.start(cast(World, world))
    return controller, world


def moved(controller: EndEffectorController, offsets: dict[str, Sequence[float]], opening: float = 1.0):
    """Commands that move the hands from where they are by offsets, m."""
    return {side: HandCommand(controller.hand_pose(side).translated(offsets[side]), opening) for side in SIDES}


STILL = dict.fromkeys(SIDES, (0.0, 0.0, 0.0))
robots = pytest.mark.parametrize("robot", ROBOTS.values(), ids=lambda robot: robot.name)


@robots
def test_starts_in_the_posture_with_open_hands(robot: RobotSpec) -> None:
    controller, world = started(robot)
    joints = [joint for arm in robot.arms.values() for joint in arm.joints]
    fingers = [joint for arm in robot.arms.values() for joint in arm.gripper.joints]
    assert controller.joint_names == joints + fingers
    postures = [q for arm in robot.arms.values() for q in arm.posture]
    opened = [q for arm in robot.arms.values() for q in arm.gripper.opened]
    (targets,) = world.drives()
    np.testing.assert_allclose(targets, postures + opened, atol=1e-12)
    _, (_, gains, forces) = world.log[0]
    actuation = robot.actuation
    assert gains == [actuation.arm_gain] * len(joints) + [actuation.finger_gain] * len(fingers)
    assert forces == [actuation.efforts[joint] for joint in joints + fingers]
    assert controller.results == {}
    assert controller.failures == {}


@robots
@pytest.mark.parametrize("substeps", [8, 24, 29, 5])
def test_targets_ramp_over_the_period_and_fingers_go_at_once(robot: RobotSpec, substeps: int) -> None:
    controller, world = started(robot, substeps)
    start = world.drives()[-1]
    arms = len(start) - 2 * len(robot.arms["left"].gripper.joints)
    world.log.clear()
    controller.apply(moved(controller, {"left": (0.01, 0.0, 0.0), "right": (0.0, 0.0, 0.01)}, opening=0.3))
    assert controller.failures == {}
    kinds = [kind for kind, _ in world.log]
    assert kinds == ["drive", "step"] * controller.RAMP_STEPS
    steps = [entry for kind, entry in world.log if kind == "step"]
    assert sum(steps) == substeps
    assert max(steps) - min(steps) <= 1
    targets = world.drives()
    goal = targets[-1]
    assert np.abs(goal - start)[:arms].max() > 1e-3
    for i, target in enumerate(targets, 1):
        np.testing.assert_allclose(target[:arms], (start + (goal - start) * i / len(targets))[:arms], atol=1e-12)
        np.testing.assert_array_equal(target[arms:], goal[arms:])
    fingers = [q for side in SIDES for q in robot.arms[side].gripper.targets(0.3)]
    np.testing.assert_allclose(goal[arms:], fingers)


@robots
def test_hands_arrive_where_they_are_sent(robot: RobotSpec) -> None:
    controller, world = started(robot)
    commands = moved(controller, {"left": (0.01, -0.01, 0.02), "right": (-0.01, 0.02, 0.0)}, opening=0.4)
    controller.apply(commands)
    state = controller.observe()
    assert state.shape == (16,)
    for side in SIDES:
        hand = state[hand_slice(side)]
        np.testing.assert_allclose(hand[:3], commands[side].pose.position, atol=2e-4)
        assert hand[-1] == pytest.approx(0.4)
        assert hand[3:7] @ np.array(robot.hand_reference) >= 0.0
        assert controller.opening(side) == pytest.approx(0.4)
    # The next period starts from these targets.
    before = world.drives()[-1]
    world.log.clear()
    controller.apply(commands)
    assert np.abs(world.drives()[0] - before).max() < 1e-3


@robots
def test_an_arm_out_of_reach_keeps_its_targets_and_the_other_moves(robot: RobotSpec) -> None:
    for lost, other in (SIDES, SIDES[::-1]):
        controller, world = started(robot)
        before = world.drives()[-1]
        controller.apply(moved(controller, STILL | {lost: (1.5, 0.0, 0.0), other: (0.0, 0.0, 0.02)}))
        assert list(controller.failures) == [lost]
        assert controller.failures[lost].startswith("out of reach by ")
        assert set(controller.results) == set(SIDES)
        change = dict(zip(controller.joint_names, np.abs(world.drives()[-1] - before), strict=True))
        assert all(change[joint] == 0.0 for joint in robot.arms[lost].joints)
        assert any(change[joint] > 1e-3 for joint in robot.arms[other].joints)


@robots
def test_a_failure_is_forgotten_when_the_hand_can_be_reached_again(robot: RobotSpec) -> None:
    controller, world = started(robot)
    controller.apply(moved(controller, STILL | {"left": (1.5, 0.0, 0.0)}))
    controller.apply(moved(controller, STILL))
    assert controller.failures == {}
    controller.apply(moved(controller, STILL | {"right": (1.5, 0.0, 0.0)}))
    controller.start(cast(World, world))
    assert controller.results == {}


@robots
def test_all_joints_of_an_arm_are_slowed_alike(robot: RobotSpec) -> None:
    """The first joint to reach its speed limit sets the pace; the step keeps its direction."""
    free = IKSettings(max_joint_step=np.inf)
    slow = replace(robot, actuation=replace(robot.actuation, velocities=dict.fromkeys(robot.actuation.velocities, 0.2)))
    fast = replace(robot, actuation=replace(robot.actuation, velocities=dict.fromkeys(robot.actuation.velocities, 1e9)))
    changes = []
    for variant in (slow, fast):
        controller, world = started(variant, settings=free)
        before = world.drives()[-1]
        controller.apply(moved(controller, STILL | {"left": (0.0, 0.1, 0.0), "right": (0.0, 0.002, 0.0)}))
        assert controller.failures == {}
        change = world.drives()[-1] - before
        left, right = (np.array([change[controller.joint_names.index(j)] for j in robot.arms[s].joints]) for s in SIDES)
        changes.append((left, right, world.physics.control_period))
    (slowed, right_slow, period), (whole, right_fast, _) = changes
    assert np.abs(slowed).max() == pytest.approx(0.2 * period)
    np.testing.assert_allclose(slowed / np.abs(slowed).max(), whole / np.abs(whole).max(), atol=1e-9)
    np.testing.assert_allclose(right_slow, right_fast, atol=1e-12)  # an arm below its limit is not slowed


@robots
def test_holding_only_steps(robot: RobotSpec) -> None:
    controller, world = started(robot)
    world.log.clear()
    controller.hold(7)
    assert world.log == [("step", 7)]


def test_unreachable_command_holds_the_real_arm_and_says_so() -> None:
    env = BimanualEnv()
    with closing(env):
        observation, _ = env.reset(seed=0)
        action = observation["agent_pos"].copy()
        action[hand_slice("left")][0] += 1.5
        after, _, _, _, info = env.step(action)
        assert "left" in info["ik_failure"]
        assert "right" not in info["ik_failure"]
        moved_by = hand_poses(after["agent_pos"][None])[0, 0] - hand_poses(observation["agent_pos"][None])[0, 0]
        assert np.linalg.norm(moved_by[:3]) < 2e-3


def test_real_joints_respect_their_speed_limits() -> None:
    env = BimanualEnv()
    with closing(env):
        observation, _ = env.reset(seed=0)
        arm = env.robot_spec.arms["left"]
        indices = env.world.joint_indices(ROBOT, arm.joints)
        before = env.world.joint_positions(ROBOT, indices)
        action = observation["agent_pos"].copy()
        action[hand_slice("left")][1] += 0.2  # two metres a second
        _, _, _, _, info = env.step(action)
        assert not info["ik_failure"]
        speeds = np.abs(env.world.joint_positions(ROBOT, indices) - before) / env.world.physics.control_period
        limits = np.array([env.robot_spec.actuation.velocities[joint] for joint in arm.joints])
        assert (speeds <= 1.1 * limits).all()
        assert speeds.max() > 0.5
