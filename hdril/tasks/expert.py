"""The scripted expert. It gets the observations of a learned policy, and answers with an action and its primitive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Decision, Explanation, Observation
from hdril.geometry import Pose
from hdril.simulation.actions import HandCommand, split_action
from hdril.simulation.robots.spec import SIDES
from hdril.tasks.primitives import Hands, Noise, Scene, plan
from hdril.tasks.task import Task


class ScriptedExpert:
    """Plays a task's primitives in order, planning each from the observation at its first frame.

    Its noise comes from ``seed`` alone, so a demonstration can be made again from the task, the seed and ``noise``.
    """

    def __init__(self, task: Task, noise: Noise | None = None) -> None:
        self.task, self.noise = task, noise or Noise()
        self._certain = np.eye(len(task.labels), dtype=np.float32)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start again, for the episode of this seed."""
        self._rng = np.random.default_rng([seed, 1])  # a stream of its own beside the environment's
        self._script = iter(self.task.primitives)
        self._label = -1
        self._hands: Hands | None = None
        self._waypoints: list[NDArray[np.float64]] = []

    def act(self, observation: Observation) -> Decision:
        """The next step.

        Raises:
            StopIteration: the primitives are over; :meth:`reset` first.
        """
        if not self._waypoints:
            primitive = next(self._script)
            self._waypoints = list(plan(primitive, self._scene(observation), self.noise, self._rng))
            self._label = self.task.labels.index(primitive.name)
        action = self._waypoints.pop(0)
        self._hands = split_action(action)
        return Decision(action, Explanation(self._label, self._certain[self._label]))

    def _scene(self, observation: Observation) -> Scene:
        # Planned from the last commands, not from the measured hands: a load pulls a hand away from its target, and planning
        # from there would loosen the grip a little with every primitive.
        hands = self._hands or split_action(observation["agent_pos"])
        vectors = np.asarray(observation["environment_state"], dtype=np.float64).reshape(-1, 7)
        return Scene(
            {side: HandCommand(hands[side].pose, hands[side].opening) for side in SIDES},
            {name: Pose.from_vector(vector) for name, vector in zip(self.task.observed, vectors, strict=True)},
        )
