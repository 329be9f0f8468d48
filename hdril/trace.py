"""One episode, frame by frame, with all that viewers draw and scores are computed from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Actor, Explanation, Observation
from hdril.env import BimanualEnv
from hdril.geometry import IDENTITY_QUATERNION
from hdril.rollout import Ending, Transition, run_episode
from hdril.simulation.robots.spec import SIDES
from hdril.simulation.world import ROBOT
from hdril.tasks.scenario import Scenario


@dataclass(frozen=True)
class Trace:
    """One episode of T frames. States have T + 1 rows, because they also hold what was observed after the last action."""

    state: NDArray[np.float32]  # (T + 1, 16)
    environment_state: NDArray[np.float32]  # (T + 1, 7 per object, then attributes), as it was observed
    action: NDArray[np.float32]  # (T, 16)
    joints: NDArray[np.float64]  # (T + 1, joints of the robot)
    reward: NDArray[np.float32]  # (T,)
    scripted: NDArray[np.int64]  # (T,), label of the expert; -1 after its last frame
    explanations: tuple[Explanation | None, ...]  # (T,)
    ik_failures: tuple[str, ...]  # (T,), empty strings where there was none
    stage: NDArray[np.int64]  # (T + 1,), how many of the task's stages were reached; success is the last
    measures: NDArray[np.float64]  # (T + 1, measures of the task)
    ik_error: NDArray[
        np.float64
    ]  # (T, 2), m: distance of the solution of inverse kinematics from the command, left and right
    grip_force: NDArray[np.float64]  # (T + 1, 2), N: force of the pads of each hand on objects
    contacts: dict[str, NDArray[np.bool_]]  # (T + 1,) by "first, second": whether they touch
    poses: dict[
        str, NDArray[np.float64]
    ]  # (T + 1, 7) by body, in the order of the task: where it was, without noise or delay
    held: dict[str, NDArray[np.bool_]]  # (T + 1, 2) by observed body: whether all pads of a hand touch it
    peak_force: NDArray[np.float64]  # (T + 1,), N: the largest force of the robot on one body, at the end of the frame
    events: tuple[str, ...]  # (T,), what happened to the episode from this frame on; empty strings where nothing did
    scenario: Scenario

    @property
    def executed(self) -> NDArray[np.int64]:
        """(T,), label of the primitive that the actor executes; -1 if it has none."""
        return np.array([-1 if e is None else e.primitive for e in self.explanations])

    @property
    def predicted(self) -> NDArray[np.int64]:
        """(T,), label of the primitive that the planner finds most probable; -1 if there is no planner, or if it knows none
        of the task's primitives.

        It may differ from :attr:`executed`: the actor asks the planner only when a primitive is over.
        """
        return np.array([_most_probable(explanation) for explanation in self.explanations])


def _most_probable(explanation: Explanation | None) -> int:
    # Probabilities of primitives that are not the task's are left out: all may be 0, and then argmax means nothing.
    if explanation is None or not explanation.probabilities.any():
        return -1
    return int(explanation.probabilities.argmax())


@dataclass(frozen=True)
class _Touches:
    """Contacts at the end of a frame."""

    grip_force: NDArray[np.float64]  # (2,), N: of the pads of each hand on observed bodies
    peak_force: float
    """The largest force of the robot on one body, N."""
    held: dict[str, tuple[bool, ...]]
    """By observed body, for each hand: whether all its pads touch it."""
    pairs: dict[str, bool]
    """Which pairs of bodies touch; one of each pair is observed."""


def _touches(env: BimanualEnv) -> _Touches:
    world, task = env.world, env.task_spec
    touched = {body.name: world.contacts(ROBOT, body.name) for body in task.bodies}
    grip_force, held, pairs = np.zeros(len(SIDES)), {}, {}
    for i, name in enumerate(task.observed):
        pairs[f"{ROBOT}, {name}"] = bool(touched[name])
        links = {contact.link_a for contact in touched[name]}
        held[name] = tuple(links.issuperset(arm.gripper.pads) for arm in env.robot_spec.arms.values())
        for side, arm in enumerate(env.robot_spec.arms.values()):
            grip_force[side] += sum(contact.force for contact in touched[name] if contact.link_a in arm.gripper.pads)
        others = [body.name for body in task.bodies if body.name not in task.observed[: i + 1]]
        pairs |= {f"{name}, {other}": bool(world.contacts(name, other)) for other in others}
    peak = max(sum(contact.force for contact in contacts) for contacts in touched.values())
    return _Touches(grip_force, float(peak), held, pairs)


class TraceRecorder:
    """An observer that collects an episode, frame by frame."""

    def begin(self, env: BimanualEnv, observation: Observation, info: dict[str, Any]) -> None:
        """Start with the first observation of an episode."""
        self._env = env
        self._progress_keys = ("stage", *(measure.name for measure in env.task_spec.measures))
        self._joints = env.world.joint_indices(ROBOT, env.controller.joint_names)
        self._observations: list[Observation] = []
        self._positions: list[NDArray[np.float64]] = []
        self._progress: list[list[float]] = []
        self._touches: list[_Touches] = []
        self._poses: list[list[NDArray[np.float64]]] = []
        self._transitions: list[Transition] = []
        self._ik_errors: list[list[float]] = []
        self._see(observation, info)

    def _see(self, observation: Observation, info: dict[str, Any]) -> None:
        self._observations.append(observation)
        self._positions.append(self._env.world.joint_positions(ROBOT, self._joints))
        self._progress.append([info[key] for key in self._progress_keys])
        self._touches.append(_touches(self._env))
        world, bodies = self._env.world, self._env.task_spec.bodies
        self._poses.append([world.pose(body.name).aligned_to(IDENTITY_QUATERNION).as_vector() for body in bodies])

    def observe(self, transition: Transition) -> None:
        """Add a frame."""
        self._transitions.append(transition)
        self._ik_errors.append([self._env.controller.results[side].position_error for side in SIDES])
        self._see(transition.next_observation, transition.info)

    def trace(self, labels: NDArray[np.int64]) -> Trace:
        """The episode so far; ``labels`` are the expert's."""
        scripted = np.full(len(self._transitions), -1)
        scripted[: len(labels)] = labels[: len(self._transitions)]
        touches, paths = self._touches, np.array(self._poses).swapaxes(0, 1)
        return Trace(
            state=np.stack([o["agent_pos"] for o in self._observations]),
            environment_state=np.stack([o["environment_state"] for o in self._observations]),
            action=np.stack([t.decision.action for t in self._transitions]),
            joints=np.stack(self._positions),
            reward=np.array([t.reward for t in self._transitions], np.float32),
            scripted=scripted,
            explanations=tuple(t.decision.explanation for t in self._transitions),
            ik_failures=tuple(t.info["ik_failure"] for t in self._transitions),
            stage=np.array([row[0] for row in self._progress]),
            measures=np.array([row[1:] for row in self._progress], dtype=np.float64),
            ik_error=np.array(self._ik_errors),
            grip_force=np.stack([now.grip_force for now in touches]),
            contacts={pair: np.array([now.pairs[pair] for now in touches]) for pair in touches[0].pairs},
            poses={body.name: poses for body, poses in zip(self._env.task_spec.bodies, paths, strict=True)},
            held={name: np.array([now.held[name] for now in touches]) for name in touches[0].held},
            peak_force=np.array([now.peak_force for now in touches]),
            events=tuple(t.info["events"] for t in self._transitions),
            scenario=self._env.scenario,
        )


def trace_episode(
    env: BimanualEnv,
    actor: Actor,
    seed: int,
    labels: NDArray[np.int64] | None = None,
    scenario: Scenario | None = None,
) -> tuple[Trace, Ending]:
    """Play the scene of ``seed``, or a scenario, and trace it. ``labels`` are the expert's; the actor's own unless given."""
    recorder = TraceRecorder()
    ending = run_episode(env, actor, seed, recorder, scenario=scenario)
    trace = recorder.trace(np.array([], np.int64) if labels is None else labels)
    return (replace(trace, scripted=trace.executed) if labels is None else trace), ending
