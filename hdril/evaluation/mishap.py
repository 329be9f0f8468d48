"""What a policy does when its first grasp comes to nothing: its actions are changed while the first primitive plays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Actor, Decision, Observation
from hdril.simulation.actions import ACTION_NAMES, hand_slice
from hdril.simulation.robots.spec import SIDES
from hdril.tasks import Task

TOO_HIGH = 0.06
"""m by which hands arrive too high."""
_FINGERS = [i for i, name in enumerate(ACTION_NAMES) if name.endswith("gripper.pos")]
_HEIGHTS = [hand_slice(side).start + 2 for side in SIDES]
_Action = NDArray[np.float32]


@dataclass(frozen=True)
class Mishap:
    """Changes actions (16,) of a policy, which is not told so."""

    words: str
    """What happens, as a clause."""
    change: Callable[[_Action, _Action], None]
    """Writes into an action; is given the hands' state (16,) at the episode's first frame, too."""


def _stay(action: _Action, start: _Action) -> None:
    action[:] = start


def _open(action: _Action, start: _Action) -> None:
    action[_FINGERS] = 1.0


def _rise(action: _Action, start: _Action) -> None:
    action[_HEIGHTS] += TOO_HIGH


MISHAPS = {
    "hands_stay": Mishap("the hands stay where they are", _stay),
    "fingers_open": Mishap("the fingers stay open", _open),
    "hands_high": Mishap(f"the hands arrive {100 * TOO_HIGH:g} cm too high", _rise),
}


def frames_of(task: Task) -> int:
    """Frames during which a mishap changes actions: those of the task's first primitive."""
    return task.primitives[0].frames


def describe_mishap(name: str, task: Task) -> str:
    """What happens, as a sentence."""
    return f"During the first {frames_of(task)} frames, {MISHAPS[name].words}, whatever the policy answers."


class MishapActor:
    """An actor whose commands are changed by a mishap. It answers as it would: :attr:`~hdril.actor.Decision.sent` is what the
    robot gets.

    Raises:
        KeyError: there is no such mishap.
    """

    def __init__(self, actor: Actor, name: str, task: Task) -> None:
        self._actor, self._mishap, self._frames = actor, MISHAPS[name], frames_of(task)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""
        self._actor.reset(seed)
        self._start: _Action | None = None
        self._frame = 0

    def act(self, observation: Observation) -> Decision:
        """The actor's decision, and what the robot is told instead."""
        decision = self._actor.act(observation)
        start = observation["agent_pos"].copy() if self._start is None else self._start
        self._start, self._frame = start, self._frame + 1
        if self._frame > self._frames:
            return decision
        sent = np.array(decision.action, np.float32)
        self._mishap.change(sent, start)
        return replace(decision, sent=sent)
