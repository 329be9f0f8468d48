"""Success and progress, as small parts that compose.

A condition tests the world, a measure reads a number from it, and a stage is a step on the way to success.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hdril.simulation.world import World


@dataclass(frozen=True)
class Condition:
    """A named test of the world. Reports print ``name`` when it fails."""

    name: str
    holds: Callable[[World], bool]


@dataclass(frozen=True)
class Measure:
    """A named number that is read from the world, for logs. ``name`` ends in its unit."""

    name: str
    read: Callable[[World], float]


@dataclass(frozen=True)
class Stage:
    """A step on the way to success.

    It is reached at the first frame at which its conditions hold and all stages before it have been reached.
    """

    name: str
    conditions: tuple[Condition, ...]


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
    """The two bodies have a contact point."""
    return Condition(f"{body} on {other}", lambda world: bool(world.contacts(body, other)))


def not_touching(body: str, other: str) -> Condition:
    """The two bodies have no contact point."""
    return Condition(f"{body} free of {other}", lambda world: not world.contacts(body, other))


def lies_at(body: str, axis: str, position: float, tolerance: float = 0.01) -> Condition:
    """The body's coordinate along a world axis (``x``, ``y`` or ``z``) is within ``tolerance`` of ``position``, m."""
    return Condition(
        f"{body} at {axis} = {position:g} m",
        lambda world: bool(abs(world.pose(body).position["xyz".index(axis)] - position) < tolerance),
    )


def raised(body: str, height: float) -> Condition:
    """The body's foot point is higher than ``height``, m."""
    return Condition(f"{body} raised by {height:g} m", lambda world: bool(world.pose(body).position[2] > height))


def failed(conditions: tuple[Condition, ...], world: World) -> tuple[str, ...]:
    """Names of the conditions that do not hold; empty means success."""
    return tuple(condition.name for condition in conditions if not condition.holds(world))
