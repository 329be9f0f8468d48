"""The interface of whatever acts on an environment: the scripted expert, a LeRobot policy, recorded actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Observation = dict[str, NDArray[np.float32]]
"""``agent_pos`` (16,) and ``environment_state`` (7 per object, then attributes), see :class:`hdril.env.BimanualEnv`."""


@dataclass(frozen=True)
class Explanation:
    """Why an actor that has primitives chose an action. Primitives are indices into the task's labels."""

    primitive: int
    """The primitive that it executes; -1 if the task has no primitive of that name."""
    probabilities: NDArray[np.float32]
    """(K,), how probable its planner finds each primitive of the task."""
    plan: NDArray[np.float32] | None = None
    """(M, 16), the actions that are planned from here on, to the end of the primitive or for fewer frames; None unless they were
    planned at this frame."""
    attention: dict[str, float] | None = None
    """Share of the model's attention that each hand and object receives; None if it has no attention."""
    events: tuple[str, ...] = ()
    """What it noticed at this frame, in words."""
    starts: bool = False
    """Whether the primitive starts at this frame. It tells one primitive that is played twice from one that goes on."""


@dataclass(frozen=True)
class Decision:
    """The answer to an observation: an action (16,), and why it was chosen if the actor can tell."""

    action: NDArray[np.floating]
    explanation: Explanation | None = None
    sent: NDArray[np.floating] | None = None
    """What the robot is told instead, where the action is perturbed on purpose; datasets keep ``action``."""


class Actor(Protocol):
    """Answers observations with actions, one episode at a time."""

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed. An actor that draws random numbers draws the same ones for the same seed."""
        ...

    def act(self, observation: Observation) -> Decision: ...


@runtime_checkable
class Privileged(Protocol):
    """An actor that is shown the scene as it is, without the sensor's noise and delay, and with all that may vary.

    A demonstrator may be: what it does is learned from what the sensor shows.
    """

    privileged: bool


class ReplayActor:
    """Answers with the rows of ``actions`` (T, 16), whatever it sees.

    Raises:
        IndexError: :meth:`act` is called more than T times.
    """

    def __init__(self, actions: NDArray[np.floating]) -> None:
        self._actions, self._frame = actions, 0

    def reset(self, seed: int) -> None:
        self._frame = 0

    def act(self, observation: Observation) -> Decision:
        self._frame += 1
        return Decision(self._actions[self._frame - 1])
