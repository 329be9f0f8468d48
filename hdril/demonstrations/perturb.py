"""Demonstrations of how to come back: the robot is disturbed, and the record says what it should have done.

Source: Laskey et al., DART: Noise Injection for Robust Imitation Learning, CoRL 2017.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Actor, Decision, Observation
from hdril.simulation.actions import hand_slice
from hdril.simulation.robots.spec import SIDES

MAX_PERTURBATION = 0.03
MAX_STRAY = 0.1
STRAYS = 1.0 / 50.0
"""Probability, at each frame, that a hand begins to stray."""
STRAY_FRAMES = (6, 14)
"""Fewest and most frames for which a hand strays: as long as an approach, so that now and then a grasp misses."""


def check_perturbation(deviation: float, stray: float = 0.0) -> None:
    """Raises ValueError unless they are standard deviations, m, that the hands can bear."""
    for name, value, most in (("perturb", deviation, MAX_PERTURBATION), ("stray", stray, MAX_STRAY)):
        if not 0.0 <= value <= most:
            raise ValueError(f"{name} must be from 0 to {most} m, got {value}")


class PerturbedActor:
    """An actor whose commands reach the robot with noise: at every frame, each hand is sent elsewhere along each axis by a
    normal number of standard deviation ``deviation``, m. Now and then a hand strays: it is sent to places beside its way that are
    all as far off, by normal numbers of standard deviation ``stray``, m, along the axes (:data:`STRAYS`, :data:`STRAY_FRAMES`).
    Hands that are both closed are moved alike, because they may hold one body.

    The decision keeps the action that was meant; :attr:`~hdril.actor.Decision.sent` is what the robot gets.
    """

    privileged = True

    def __init__(self, actor: Actor, deviation: float, stray: float = 0.0) -> None:
        check_perturbation(deviation, stray)
        self._actor, self._deviation, self._stray = actor, deviation, stray
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""
        # Streams 0 to 2 are the scene's, the expert's and the sensor's.
        self._rng, self._strays = (np.random.default_rng([seed, stream]) for stream in (3, 4))
        self._astray: dict[str, NDArray[np.float64]] = {side: np.zeros(3) for side in SIDES}
        self._left = dict.fromkeys(SIDES, 0)
        self._actor.reset(seed)

    def act(self, observation: Observation) -> Decision:
        """The actor's decision, and what the robot is told instead."""
        decision = self._actor.act(observation)
        offsets = self._rng.normal(scale=self._deviation, size=(len(SIDES), 3))
        if self._stray:
            offsets += np.stack([self._off_its_way(side) for side in SIDES])
        sent = np.array(decision.action, dtype=np.float64)
        closed = all(sent[hand_slice(side)][-1] < 0.5 for side in SIDES)
        for row, side in enumerate(SIDES):
            sent[hand_slice(side)][:3] += offsets[0 if closed else row]
        return Decision(decision.action, decision.explanation, sent)

    def _off_its_way(self, side: str) -> NDArray[np.float64]:
        """By how much a hand strays at this frame (3,), m."""
        if self._left[side]:
            self._left[side] -= 1
        elif self._strays.uniform() < STRAYS:
            self._left[side] = int(self._strays.integers(STRAY_FRAMES[0], STRAY_FRAMES[1], endpoint=True))
            self._astray[side] = self._strays.normal(scale=self._stray, size=3)
        return self._astray[side] if self._left[side] else np.zeros(3)
