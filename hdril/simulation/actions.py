"""Actions: 16 numbers, or a command for each hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import POSE_AXES, Pose
from hdril.simulation.robots.spec import SIDES

ACTION_NAMES: tuple[str, ...] = tuple(
    name for side in SIDES for name in (*(f"{side}_ee.{axis}" for axis in POSE_AXES), f"{side}_gripper.pos")
)
"""Names of the 16 numbers of an action, and of ``observation.state``."""
HAND_WIDTH = len(POSE_AXES) + 1
"""Numbers of one hand: a pose and an opening."""


def hand_slice(side: str) -> slice:
    """Where the numbers of a hand stand in an action or in ``observation.state``.

    Raises:
        ValueError: there is no such side.
    """
    if side not in SIDES:
        raise ValueError(f"no hand {side!r}; hands: {', '.join(SIDES)}")
    first = SIDES.index(side) * HAND_WIDTH
    return slice(first, first + HAND_WIDTH)


def hand_poses(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """Poses (T, 2, 7) of both hands from actions or states (T, 16): m, unit quaternions, left before right."""
    return np.asarray(rows, dtype=np.float64).reshape(len(rows), len(SIDES), HAND_WIDTH)[..., : len(POSE_AXES)]


def openings(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """Openings (T, 2) of both hands from actions or states (T, 16): 0 closed, 1 open."""
    return np.asarray(rows, dtype=np.float64).reshape(len(rows), len(SIDES), HAND_WIDTH)[..., -1]


@dataclass(frozen=True)
class HandCommand:
    """The command of one hand: a tool pose in the world, and an opening from 0 (closed) to 1."""

    pose: Pose
    opening: float


def check_action(action: NDArray[np.floating]) -> NDArray[np.float64]:
    """The action as float64 (16,).

    Raises:
        ValueError: wrong shape, a number that is not finite, or a quaternion of length 0; names the entries.
    """
    array = np.asarray(action, dtype=np.float64)
    if array.shape != (len(ACTION_NAMES),):
        raise ValueError(
            f"an action has {len(ACTION_NAMES)} numbers, {ACTION_NAMES[0]} to {ACTION_NAMES[-1]}; got shape {array.shape}"
        )
    values = array.tolist()
    if not all(map(math.isfinite, values)):
        bad = [f"{name} = {value}" for name, value in zip(ACTION_NAMES, array, strict=True) if not np.isfinite(value)]
        raise ValueError(f"the action is not finite: {', '.join(bad)}")
    for side in SIDES:
        if math.hypot(*values[hand_slice(side)][3:7]) < 1e-6:
            raise ValueError(f"the action's {side}_ee quaternion has length 0")
    return array


def split_action(action: NDArray[np.floating]) -> dict[str, HandCommand]:
    """Commands by side, from 16 numbers in the order of :data:`ACTION_NAMES`. Raises as :func:`check_action`."""
    array = check_action(action)
    return {
        side: HandCommand(Pose.from_vector(hand[:-1]), min(max(float(hand[-1]), 0.0), 1.0))
        for side, hand in zip(SIDES, array.reshape(len(SIDES), HAND_WIDTH), strict=True)
    }


def join_action(commands: dict[str, HandCommand]) -> NDArray[np.float64]:
    """The inverse of :func:`split_action`."""
    return np.concatenate([np.append(commands[side].pose.as_vector(), commands[side].opening) for side in SIDES])
