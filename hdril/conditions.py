"""Success, as small conditions that compose. A condition reads the world and says whether it holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hdril.world import World

ROBOT = "robot"
"""The name under which every world knows its robot."""


@dataclass(frozen=True)
class Condition:
    """A named test of the world; ``name`` is what reports say when it fails."""

    name: str
    holds: Callable[[World], bool]


def upright(body: str, min_cosine: float = 0.99) -> Condition:
    """The body's z axis is within arccos(``min_cosine``) of vertical."""

    def holds(world: World) -> bool:
        return bool(world.pose(body).rotation_matrix()[2, 2] > min_cosine)

    return Condition(f"{body} upright", holds)


def at_rest(body: str, max_speed: float = 0.01) -> Condition:
    """The body's centre of mass is slower than ``max_speed``, m/s."""
    return Condition(f"{body} at rest", lambda world: bool(np.linalg.norm(world.velocity(body)[0]) < max_speed))


def at_height(body: str, height: float, tolerance: float = 0.01) -> Condition:
    """The origin of the body is within ``tolerance`` of ``height``, m."""
    return Condition(
        f"{body} at height {height:g} m", lambda world: bool(abs(world.pose(body).position[2] - height) < tolerance)
    )


def touching(body: str, other: str) -> Condition:
    return Condition(f"{body} on {other}", lambda world: bool(world.contacts(body, other)))


def not_touching(body: str, other: str) -> Condition:
    return Condition(f"{body} free of {other}", lambda world: not world.contacts(body, other))


def failed(conditions: tuple[Condition, ...], world: World) -> tuple[str, ...]:
    """Names of the conditions that do not hold; empty means success."""
    return tuple(condition.name for condition in conditions if not condition.holds(world))
