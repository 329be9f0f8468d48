"""Demonstrations of how to come back: the robot is disturbed, and the record says what it should have done.

Source: Laskey et al., DART: Noise Injection for Robust Imitation Learning, CoRL 2017.
"""

from __future__ import annotations

import numpy as np

from hdril.actor import Actor, Decision, Observation
from hdril.simulation.actions import hand_slice
from hdril.simulation.robots.spec import SIDES

MAX_PERTURBATION = 0.03


def check_perturbation(deviation: float) -> None:
    """Raises ValueError unless it is a standard deviation, m, that the hands can bear."""
    if not 0.0 <= deviation <= MAX_PERTURBATION:
        raise ValueError(f"perturb must be from 0 to {MAX_PERTURBATION} m, got {deviation}")


class PerturbedActor:
    """An actor whose commands reach the robot with noise: at every frame, each hand is sent elsewhere along each axis by a
    normal number of standard deviation ``deviation``, m. Hands that are both closed are moved alike, because they may hold one
    body.

    The decision keeps the action that was meant; :attr:`~hdril.actor.Decision.sent` is what the robot gets.
    """

    privileged = True

    def __init__(self, actor: Actor, deviation: float) -> None:
        check_perturbation(deviation)
        self._actor, self._deviation = actor, deviation
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""
        self._rng = np.random.default_rng([seed, 3])  # streams 0 to 2 are the scene's, the expert's and the sensor's
        self._actor.reset(seed)

    def act(self, observation: Observation) -> Decision:
        """The actor's decision, and what the robot is told instead."""
        decision = self._actor.act(observation)
        offsets = dict(zip(SIDES, self._rng.normal(scale=self._deviation, size=(len(SIDES), 3)), strict=True))
        sent = np.array(decision.action, dtype=np.float64)
        closed = all(sent[hand_slice(side)][-1] < 0.5 for side in SIDES)
        for side in SIDES:
            sent[hand_slice(side)][:3] += offsets[SIDES[0] if closed else side]
        return Decision(decision.action, decision.explanation, sent)
