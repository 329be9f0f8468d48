"""Forward kinematics against finite differences, and against PyBullet."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from hdril.env import BimanualEnv
from hdril.geometry import geodesic_distance
from hdril.simulation.kinematics import Chain
from hdril.simulation.robots import ROBOTS
from hdril.simulation.world import ROBOT
from tests.simulation.chains import ARMS


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_jacobian_matches_finite_differences(chain, posture) -> None:
    rng, step = np.random.default_rng(0), 1e-6
    for _ in range(5):
        q = rng.uniform(chain.lower, chain.upper)
        transform, jacobian = chain.transform_and_jacobian(q)
        for i in range(len(q)):
            moved, _ = chain.transform_and_jacobian(q + step * np.eye(len(q))[i])
            np.testing.assert_allclose((moved[:3, 3] - transform[:3, 3]) / step, jacobian[:3, i], atol=1e-5)
            spin = (moved[:3, :3] @ transform[:3, :3].T - np.eye(3)) / step
            np.testing.assert_allclose([spin[2, 1], spin[0, 2], spin[1, 0]], jacobian[3:, i], atol=1e-5)


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


def test_a_chain_that_is_not_in_the_model_is_refused() -> None:
    spec = ROBOTS["baxter"]
    with pytest.raises(ValueError, match=r"no chain from 'right_gripper' to 'left_gripper'; it ends at 'base'"):
        Chain(spec.source(), "right_gripper", "left_gripper")
    with pytest.raises(ValueError, match="is not revolute about z"):
        Chain(spec.source(), "left_gripper_base", "l_gripper_l_finger")
