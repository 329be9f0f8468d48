"""Every arm of every robot, for parametrised tests."""

from __future__ import annotations

import numpy as np
import pytest

from hdril.simulation.kinematics import Chain
from hdril.simulation.robots import ROBOTS, SIDES

ARMS = [
    pytest.param(Chain(robot.source(), robot.base_link, robot.arms[side].tool), np.array(robot.arms[side].posture),
                 id=f"{robot.name}-{side}")
    for robot in ROBOTS.values()
    for side in SIDES
]  # fmt: skip
"""Pairs of a chain and the posture that it prefers (n,), rad."""
