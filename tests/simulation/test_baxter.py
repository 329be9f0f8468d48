"""The simulated robot beside the manufacturer's model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pybullet as bullet
import pytest
from numpy.typing import NDArray

from hdril.simulation.robots.baxter import BAXTER


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
