"""What a policy does when its first grasp comes to nothing: its actions are changed until the grasp would be over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Actor, Decision, Observation
from hdril.evaluation.reference import Reference
from hdril.simulation.actions import ACTION_NAMES, hand_slice
from hdril.simulation.robots.spec import SIDES

TOO_HIGH = 0.06
"""m by which hands arrive too high."""
CLOSED = 0.95
"""A hand that is less open than this has begun to close; 1 is open, 0 closed."""
_FINGERS = [i for i, name in enumerate(ACTION_NAMES) if name.endswith("gripper.pos")]
_HEIGHTS = [hand_slice(side).start + 2 for side in SIDES]
_Action = NDArray[np.float32]


@dataclass(frozen=True)
class Mishap:
    """Something that happens to a policy, which is not told so."""

    words: str
    """What happens, as a clause."""
    change: Callable[[_Action, _Action], None]
    """Changes an action (16,) in place. The second argument is the hands' state (16,) at the first frame. Both have positions
    in m, and 1 for an open hand."""


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


def describe_mishap(name: str) -> str:
    """What happens, as a sentence.

    Raises:
        KeyError: there is no such mishap.
    """
    return f"Until the expert's first grasp of the scene would be over, {MISHAPS[name].words}, whatever the policy answers."


def first_grasp_ends(reference: Reference) -> int:
    """The frame at which the expert's first primitive in which a hand closes is over; 0 if none ever does."""
    closing = np.flatnonzero((reference.state[1:, _FINGERS] < CLOSED).any(axis=1))
    if not closing.size:
        return 0
    rest = reference.scripted[closing[0] :]
    others = np.flatnonzero(rest != rest[0])
    return int(closing[0] + (others[0] if others.size else len(rest)))


class MishapActor:
    """An actor whose commands are changed by a mishap during the first ``frames`` frames. It answers as it would:
    :attr:`~hdril.actor.Decision.sent` is what the robot gets.

    Raises:
        KeyError: there is no such mishap.
    """

    def __init__(self, actor: Actor, name: str, frames: int) -> None:
        self._actor, self._mishap, self._frames = actor, MISHAPS[name], frames
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
