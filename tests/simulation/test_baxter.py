"""The simulated robot beside the manufacturer's model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pybullet as bullet
import pytest
from numpy.typing import NDArray

from hdril.simulation.robots.baxter import BAXTER, COLLISION_BOXES, LEFT_OUT


def equations_of_motion(urdf: Path, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Mass matrix and the forces that hold against velocities, at joint positions by name; and how many links there are."""
    client = bullet.connect(bullet.DIRECT)
    try:
        flags = bullet.URDF_USE_INERTIA_FROM_FILE
        body = bullet.loadURDF(str(urdf), useFixedBase=1, flags=flags, physicsClientId=client)
        links = bullet.getNumJoints(body, physicsClientId=client)
        told = [bullet.getJointInfo(body, i, physicsClientId=client) for i in range(links)]
        names = [info[1].decode() for info in told if info[2] != bullet.JOINT_FIXED]
        rng = np.random.default_rng(seed)
        values = {name: rng.uniform(-0.5, 0.5, 2) for name in sorted(names)}
        q, v = (np.array([values[name][i] for name in names]).tolist() for i in range(2))
        mass = np.array(bullet.calculateMassMatrix(body, q, physicsClientId=client))
        force = np.array(bullet.calculateInverseDynamics(body, q, v, [0.0] * len(q), physicsClientId=client))
        order = np.argsort(names)
        return mass[np.ix_(order, order)], force[order], links
    finally:
        bullet.disconnect(client)


@pytest.mark.parametrize("meshes", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_links_that_are_parts_of_others_move_as_before(seed: int, meshes: bool) -> None:
    """But for some leaves of 0.1 g, which are left out."""
    theirs, ours = equations_of_motion(BAXTER.source(), seed), equations_of_motion(BAXTER.urdf(meshes), seed)
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-3)
    np.testing.assert_allclose(ours[1], theirs[1], atol=1e-3)
    assert np.abs(theirs[0]).max() > 1.0
    assert ours[2] < 0.5 * theirs[2]


def shapes(urdf: Path, seed: int) -> list[tuple[float, ...]]:
    """Kind, size and world pose of the shapes that collide, sorted; without those that ours has in another way."""
    client = bullet.connect(bullet.DIRECT)
    try:
        body = bullet.loadURDF(str(urdf), useFixedBase=1, physicsClientId=client)
        told = [
            bullet.getJointInfo(body, i, physicsClientId=client)
            for i in range(bullet.getNumJoints(body, physicsClientId=client))
        ]
        rng = np.random.default_rng(seed)
        moving = sorted(info[1] for info in told if info[2] != bullet.JOINT_FIXED)
        values = dict(zip(moving, rng.uniform(-0.5, 0.5, len(moving)), strict=True))
        for info in told:
            if info[1] in values:
                bullet.resetJointState(body, info[0], values[info[1]], physicsClientId=client)
        found = []
        for info in told:
            if info[12].decode() in (*LEFT_OUT, *COLLISION_BOXES):
                continue
            state = bullet.getLinkState(body, info[0], computeForwardKinematics=1, physicsClientId=client)
            for shape in bullet.getCollisionShapeData(body, info[0], physicsClientId=client):
                # Of shapes, PyBullet tells poses in the inertial frame of their link.
                place = bullet.multiplyTransforms(state[0], state[1], shape[5], shape[6])
                axis = bullet.getMatrixFromQuaternion(place[1])[2::3]
                found.append((shape[2], *np.round(shape[3], 4), *np.round(place[0], 4), *np.round(np.abs(axis), 3)))
        return sorted(found)
    finally:
        bullet.disconnect(client)


@pytest.mark.parametrize("seed", range(2))
def test_parts_collide_where_they_did(seed: int) -> None:
    ours, theirs = shapes(BAXTER.urdf(False), seed), shapes(BAXTER.source(), seed)
    assert len(ours) > 20
    np.testing.assert_allclose(ours, theirs, atol=2e-3)


def test_an_arm_collides_with_the_base_from_the_elbow_on() -> None:
    links = ("base", "head", *(f"{side}_{part}" for side in ("left", "right") for part in (
        "upper_shoulder", "lower_shoulder", "upper_elbow", "lower_elbow", "upper_forearm", "lower_forearm", "wrist", "gripper")),
        "l_gripper_l_finger_tip")  # fmt: skip
    ignored = {frozenset(pair) for pair in BAXTER.ignored_collisions(links)}
    touch = {link for link in links if link != "base" and frozenset(("base", link)) not in ignored}
    beyond = {
        f"{side}_{part}"
        for side in ("left", "right")
        for part in ("lower_elbow", "upper_forearm", "lower_forearm", "wrist", "gripper")
    }
    assert touch == beyond | {"l_gripper_l_finger_tip"}
    assert frozenset(("left_wrist", "right_upper_shoulder")) not in ignored
    assert frozenset(("left_wrist", "left_upper_shoulder")) in ignored
