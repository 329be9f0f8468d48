"""The scripted expert. It is shown the scene as it is, decides which primitive comes next, and answers with an action."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Decision, Explanation, Observation
from hdril.geometry import POSE_AXES, Pose
from hdril.simulation.actions import split_action
from hdril.tasks.primitives import HINDERED, Hands, Noise, Plan, Primitive, Scene
from hdril.tasks.task import Task

LAG = 0.04
"""m by which a hand that carries something is late where it is hindered: in undisturbed scenes it never is."""
HOLD = 12
"""Frames for which the hands wait for one that is late."""
PATIENCE = 2
"""Frames for which a need must be missing before a primitive is given up: a hand may swing for one."""


class ScriptedExpert:
    """Plays a task's primitives in order, as long as the scene is as each of them needs it.

    Each primitive is planned at its first frame, and again when an object moves that it follows. Where a primitive's needs do
    not hold, at its start or while it is played, the expert goes back to the last earlier one whose needs do, after the
    task's ``recovery``.

    Its noise comes from ``seed`` alone, so a demonstration can be made again from the task, the seed and ``noise``.
    """

    privileged = True

    def __init__(self, task: Task, noise: Noise | None = None) -> None:
        self.task, self.noise = task, noise or Noise()
        self._certain = np.eye(len(task.labels), dtype=np.float32)
        self._detailed = replace(task, detailed=True)
        self._detailed_length = len(self._detailed.state_names)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start again, for the episode of this seed."""
        self._rng = np.random.default_rng([seed, 1])  # a stream of its own beside the environment's
        self._queue: list[Primitive] = []
        self._next = 0
        self._hands: Hands | None = None
        self._plan: Plan | None = None
        self._missing = 0
        self._waited = 0
        self._frame = -1
        self._carries = False
        self._late = 0
        self._last: NDArray[np.float64] | None = None
        self._label = -1

    def act(self, observation: Observation) -> Decision:
        """The next step.

        Raises:
            StopIteration: the primitives are over, and nothing needs to be done again; :meth:`reset` first.
        """
        self._frame += 1
        scene, events, starts = self._look(observation), (), False
        if self._waits(scene):
            self._waited += 1
            assert self._last is not None
            return Decision(self._last, Explanation(self._label, self._certain[self._label]))
        if self._held_up(scene):
            assert self._last is not None
            return Decision(self._last, Explanation(self._label, self._certain[self._label]))
        if self._plan is not None and not self._plan.over:
            events = self._watch(self._plan, scene)
        if self._plan is None or self._plan.over:
            primitive, reason = self._choose(scene)
            scene = _as_measured(scene) if reason else scene
            self._carries = _closed(scene.hands)
            self._plan, self._missing, starts = Plan(primitive, scene, self.noise, self._rng), 0, True
            events = (*events, *reason)
        action = self._last = self._plan.next()
        self._hands = split_action(action)
        self._label = self.task.labels.index(self._plan.primitive.name)
        return Decision(action, Explanation(self._label, self._certain[self._label], events=events, starts=starts))

    def _waits(self, scene: Scene) -> bool:
        """Whether all is done and it remains to be seen that it stays so: the hands keep still.

        A plan that leaves primitives out is over before the horizon, and success is not judged until then.
        """
        script = self.task.primitives
        over = self._plan is not None and self._plan.over and self._next >= len(script) and not self._queue
        early = self._frame < self.task.horizon
        return over and (early or self._waited < self.task.dwell) and script[-1].possible(scene)

    def _held_up(self, scene: Scene) -> bool:
        """Whether a hand is kept from going where it is told while both carry something: they then wait for it."""
        carries = self._plan is not None and not self._plan.over and self._carries and _closed(scene.hands)
        ways = [math.dist(scene.hands[side].pose.position, hand.pose.position) for side, hand in scene.measured.items()]
        self._late = self._late + 1 if carries and max(ways) > LAG else 0
        return 1 <= self._late <= HOLD

    def _watch(self, plan: Plan, scene: Scene) -> tuple[str, ...]:
        """Follow what the plan follows, or give it up if what it needs is missing; says so, in words."""
        missing = [need.name for need in plan.primitive.needs if not need.holds(scene)]
        self._missing = self._missing + 1 if missing else 0
        if self._missing < PATIENCE:
            plan.follow(scene)
            return ()
        self._plan, self._next = None, self._next - 1
        return (f"gave up {plan.primitive.name}: not {missing[0]}",)

    def _choose(self, scene: Scene) -> tuple[Primitive, tuple[str, ...]]:
        """The next primitive, and why it is not the next in order."""
        if self._queue:
            return self._queue.pop(0), ()
        script = self.task.primitives
        while self._next < len(script) and script[self._next].superfluous(scene):
            self._next += 1
        if self._next < len(script) and script[self._next].possible(scene):
            self._next, self._waited = self._next + 1, 0
            return script[self._next - 1], ()
        wanted = script[self._next].name if self._next < len(script) else "success"
        again = [i for i in range(min(self._next, len(script))) if self._fits(script[i], scene)]
        if not again:
            raise StopIteration(f"nothing can be done for {wanted}")
        self._next = again[-1] + 1
        self._queue = [script[again[-1]]]
        if not self._queue[0].needs:
            labelled = [primitive for primitive in self.task.recovery if primitive.name in self.task.labels]
            self._queue = [*labelled, *self._queue]
        return self._queue.pop(0), (f"back to {script[self._next - 1].name}: {wanted} is not possible",)

    @staticmethod
    def _fits(primitive: Primitive, scene: Scene) -> bool:
        return primitive.possible(scene) and not primitive.superfluous(scene)

    def _look(self, observation: Observation) -> Scene:
        measured = split_action(observation["agent_pos"])
        values = np.asarray(observation["environment_state"], dtype=np.float64)
        task = self._detailed if len(values) == self._detailed_length else self.task
        poses = values[: len(POSE_AXES) * len(task.objects)].reshape(-1, len(POSE_AXES))
        seen = {name: Pose.from_vector(vector) for name, vector in zip(task.objects, poses, strict=True)}
        return Scene(
            self._hands or measured,
            {name: where.middle for name, where in self.task.placements.items()} | seen,
            measured,
            dict(self.task.attributes) | dict(zip([n for n, _ in task.attributes], values[poses.size :], strict=False)),
        )


def _closed(hands: Hands) -> bool:
    """Whether both hands are told to be closed."""
    return all(hand.opening < 0.5 for hand in hands.values())


def _as_measured(scene: Scene) -> Scene:
    """The scene, in which a hand that is not where it was told to be was told to be where it is."""
    hands = {
        side: replace(hand, pose=scene.measured[side].pose)
        if np.linalg.norm(hand.pose.position - scene.measured[side].pose.position) > HINDERED
        else hand
        for side, hand in scene.hands.items()
    }
    return replace(scene, hands=hands)
