"""Kinematics against finite differences and PyBullet; inverse kinematics; refusals."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from hdril.env import BimanualEnv
from hdril.geometry import geodesic_distance
from hdril.simulation.actions import ACTION_NAMES, check_action, join_action, split_action
from hdril.simulation.inverse_kinematics import IKSettings, solve_ik
from hdril.simulation.kinematics import Chain
from hdril.simulation.robots import ROBOTS, SIDES
from hdril.simulation.world import ROBOT

CHAINS = [
    pytest.param(robot, side, Chain(robot.source(), robot.base_link, robot.arms[side].tool), id=f"{robot.name}-{side}")
    for robot in ROBOTS.values()
    for side in SIDES
]


@pytest.mark.parametrize(("robot", "side", "chain"), CHAINS)
def test_jacobian_matches_finite_differences(robot, side, chain) -> None:
    rng, step = np.random.default_rng(0), 1e-6
    for _ in range(5):
        q = rng.uniform(chain.lower, chain.upper)
        transform, jacobian = chain.transform_and_jacobian(q)
        for i in range(len(q)):
            moved, _ = chain.transform_and_jacobian(q + step * np.eye(len(q))[i])
            np.testing.assert_allclose((moved[:3, 3] - transform[:3, 3]) / step, jacobian[:3, i], atol=1e-5)
            spin = (moved[:3, :3] @ transform[:3, :3].T - np.eye(3)) / step
            np.testing.assert_allclose([spin[2, 1], spin[0, 2], spin[1, 0]], jacobian[3:, i], atol=1e-5)


@pytest.mark.parametrize(("robot", "side", "chain"), CHAINS)
def test_inverse_kinematics_finds_reachable_poses(robot, side, chain) -> None:
    rng = np.random.default_rng(1)
    posture = np.array(robot.arms[side].posture)
    for _ in range(20):
        goal = np.clip(posture + rng.normal(0, 0.15, len(posture)), chain.lower, chain.upper)
        target = chain.forward(goal)
        result = solve_ik(chain, target, posture, posture, IKSettings())
        assert result.ok, result.reason
        reached = chain.forward(result.joints)
        assert np.linalg.norm(reached.position - target.position) < 1e-3
        assert geodesic_distance(reached.quaternion, target.quaternion) < 5e-3
        assert (result.joints >= chain.lower).all()
        assert (result.joints <= chain.upper).all()


@pytest.mark.parametrize(("robot", "side", "chain"), CHAINS)
def test_out_of_reach_is_said(robot, side, chain) -> None:
    posture = np.array(robot.arms[side].posture)
    far = chain.forward(posture).translated((2.0, 0.0, 0.0))
    result = solve_ik(chain, far, posture, posture, IKSettings())
    assert not result.ok
    assert "out of reach" in result.reason


@pytest.mark.parametrize("robot", ROBOTS)
def test_simulated_hands_are_where_kinematics_says(robot: str) -> None:
    env = BimanualEnv(robot=robot)
    with closing(env):
        env.reset(seed=0)
        spec = ROBOTS[robot]
        for side, arm in spec.arms.items():
            q = env.world.joint_positions(ROBOT, env.world.joint_indices(ROBOT, arm.joints))
            predicted = spec.base @ Chain(spec.source(), spec.base_link, arm.tool).forward(q)
            measured = env.controller.hand_pose(side)
            np.testing.assert_allclose(measured.position, predicted.position, atol=1e-5)
            assert geodesic_distance(measured.quaternion, predicted.quaternion) < 1e-4


def test_unreachable_command_holds_the_arm_and_says_so() -> None:
    env = BimanualEnv()
    with closing(env):
        observation, _ = env.reset(seed=0)
        action = observation["agent_pos"].copy()
        action[0] += 1.5
        after, _, _, _, info = env.step(action)
        assert "left" in info["ik_failure"]
        assert "right" not in info["ik_failure"]
        assert np.linalg.norm(after["agent_pos"][:3] - observation["agent_pos"][:3]) < 2e-3


def test_joints_respect_their_speed_limits() -> None:
    env = BimanualEnv()
    with closing(env):
        observation, _ = env.reset(seed=0)
        arm = env.robot_spec.arms["left"]
        indices = env.world.joint_indices(ROBOT, arm.joints)
        before = env.world.joint_positions(ROBOT, indices)
        action = observation["agent_pos"].copy()
        action[1] += 0.2  # two metres a second
        _, _, _, _, info = env.step(action)
        assert not info["ik_failure"]
        speeds = np.abs(env.world.joint_positions(ROBOT, indices) - before) / env.world.physics.control_period
        limits = np.array([env.robot_spec.actuation.velocities[joint] for joint in arm.joints])
        assert (speeds <= 1.1 * limits).all()
        assert speeds.max() > 0.5


def test_action_round_trip() -> None:
    rng = np.random.default_rng(2)
    action = rng.uniform(0.1, 0.9, len(ACTION_NAMES))
    for i in range(2):
        action[8 * i + 3 : 8 * i + 7] /= np.linalg.norm(action[8 * i + 3 : 8 * i + 7])
    np.testing.assert_allclose(join_action(split_action(action)), action, atol=1e-12)


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [(0, np.nan, r"left_ee\.x = nan"), (15, np.inf, r"right_gripper\.pos = inf")],
)
def test_action_that_is_not_finite_is_named(index: int, value: float, message: str) -> None:
    action = np.full(len(ACTION_NAMES), 0.5)
    action[index] = value
    with pytest.raises(ValueError, match=message):
        check_action(action)


def test_action_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="16 numbers"):
        check_action(np.zeros(14))
    with pytest.raises(ValueError, match="left_ee quaternion"):
        check_action(np.zeros(16))
