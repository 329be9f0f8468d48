"""One episode, frame by frame, with all that a viewer or a judge wants of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril.conditions import ROBOT
from hdril.demonstrator import Demonstrator, Observation
from hdril.env import BimanualEnv
from hdril.robots.spec import SIDES


@dataclass(frozen=True)
class Belief:
    """What a policy with primitives thinks at a frame, in the task's labels."""

    primitive: int
    """Label of what it plays."""
    probabilities: NDArray[np.float32]
    """(K,), the planner's."""
    plan: NDArray[np.float32] | None
    """(M, 16), the actions from here to the end of the primitive, if it has just planned anew."""
    attention: dict[str, float]
    """Share of the playing model's attention that each hand and object receives."""


@dataclass(frozen=True)
class Move:
    """What a policy answers to an observation."""

    action: NDArray[np.float32]  # (16,)
    belief: Belief | None = None


@dataclass(frozen=True)
class Trace:
    """Everything that a viewer wants of one episode of T frames. States have T + 1 rows: the last is after the end."""

    state: NDArray[np.float32]  # (T + 1, 16)
    environment_state: NDArray[np.float32]  # (T + 1, 7 per object)
    action: NDArray[np.float32]  # (T, 16)
    joints: NDArray[np.float64]  # (T + 1, joints of the robot)
    reward: NDArray[np.float32]  # (T,)
    scripted: NDArray[np.int64]  # (T,), label of the expert; -1 past its end
    beliefs: tuple[Belief | None, ...]  # (T,)
    ik_failures: tuple[str, ...]  # (T,), empty strings where there was none
    stage: NDArray[np.int64]  # (T + 1,), how many of the task's stages were reached, success being the last
    measures: NDArray[np.float64]  # (T + 1, measures of the task)
    ik_error: NDArray[np.float64]  # (T, 2), m: how far inverse kinematics stayed from the commands, left and right
    grip_force: NDArray[np.float64]  # (T + 1, 2), N: what the pads of each hand press on objects with
    contacts: dict[str, NDArray[np.bool_]]  # (T + 1,) by "first, second": whether they touch

    @property
    def executed(self) -> NDArray[np.int64]:
        """(T,), label of the primitive that the policy plays; -1 if it has none."""
        return np.array([-1 if belief is None else belief.primitive for belief in self.beliefs])

    @property
    def predicted(self) -> NDArray[np.int64]:
        """(T,), label of the primitive that the planner prefers; it is heard when one is over. -1 if there is none."""
        return np.array([-1 if belief is None else int(belief.probabilities.argmax()) for belief in self.beliefs])


Act = Callable[[Observation], Move]
"""A policy as the evaluation sees it."""


def _contacts(env: BimanualEnv) -> tuple[NDArray[np.float64], dict[str, bool]]:
    """Pressure (2,), N, of the pads of each hand on objects, and which bodies touch, for those that move."""
    world, task = env.world, env.task_spec
    force, touching = np.zeros(len(SIDES)), {}
    for i, name in enumerate(task.observed):
        held = world.contacts(ROBOT, name)
        touching[f"{ROBOT}, {name}"] = bool(held)
        for side, arm in enumerate(env.robot_spec.arms.values()):
            force[side] += sum(contact.force for contact in held if contact.link_a in arm.gripper.pads)
        others = [body.name for body in task.bodies if body.name not in task.observed[: i + 1]]
        touching |= {f"{name}, {other}": bool(world.contacts(name, other)) for other in others}
    return force, touching


class TraceRecorder:
    """Collects an episode of an environment, frame by frame.

    Args:
        env: at the start of an episode.
        observation: what its ``reset`` gave.
        info: likewise.
    """

    def __init__(self, env: BimanualEnv, observation: Observation, info: dict[str, Any]) -> None:
        self._env = env
        self._progress_keys = ("stage", *(measure.name for measure in env.task_spec.measures))
        self._joints = env.world.joint_indices(ROBOT, env.controller.joint_names)
        self._observations: list[Observation] = []
        self._positions: list[NDArray[np.float64]] = []
        self._progress: list[list[float]] = []
        self._touches: list[tuple[NDArray[np.float64], dict[str, bool]]] = []
        self._actions: list[NDArray[np.float32]] = []
        self._rewards: list[float] = []
        self._beliefs: list[Belief | None] = []
        self._failures: list[str] = []
        self._ik_errors: list[list[float]] = []
        self._see(observation, info)

    def _see(self, observation: Observation, info: dict[str, Any]) -> None:
        self._observations.append(observation)
        self._positions.append(self._env.world.joint_positions(ROBOT, self._joints))
        self._progress.append([info[key] for key in self._progress_keys])
        self._touches.append(_contacts(self._env))

    def add(self, move: Move, observation: Observation, reward: float, info: dict[str, Any]) -> None:
        """A frame: what was done, and what ``step`` gave for it."""
        self._actions.append(np.asarray(move.action, np.float32))
        self._beliefs.append(move.belief)
        self._rewards.append(reward)
        self._failures.append(info["ik_failure"])
        self._ik_errors.append([self._env.controller.results[side].position_error for side in SIDES])
        self._see(observation, info)

    def finish(self, labels: NDArray[np.int64]) -> Trace:
        """The episode; ``labels`` are the expert's."""
        scripted = np.full(len(self._actions), -1)
        scripted[: len(labels)] = labels[: len(self._actions)]
        touches = self._touches
        return Trace(
            state=np.stack([o["agent_pos"] for o in self._observations]),
            environment_state=np.stack([o["environment_state"] for o in self._observations]),
            action=np.stack(self._actions),
            joints=np.stack(self._positions),
            reward=np.array(self._rewards, np.float32),
            scripted=scripted,
            beliefs=tuple(self._beliefs),
            ik_failures=tuple(self._failures),
            stage=np.array([row[0] for row in self._progress]),
            measures=np.array([row[1:] for row in self._progress], dtype=np.float64),
            ik_error=np.array(self._ik_errors),
            grip_force=np.stack([force for force, _ in touches]),
            contacts={pair: np.array([touching[pair] for _, touching in touches]) for pair in touches[0][1]},
        )


def run_episode(env: BimanualEnv, act: Act, seed: int, labels: NDArray[np.int64]) -> tuple[Trace, bool, str]:
    """Play the scene of ``seed``; ``labels`` are the expert's. Also whether it succeeded, and what was not met."""
    observation, info = env.reset(seed=seed)
    recorder = TraceRecorder(env, observation, info)
    done = False
    while not done:
        move = act(observation)
        observation, reward, terminated, truncated, info = env.step(move.action)
        done = terminated or truncated
        recorder.add(move, observation, reward, info)
    return recorder.finish(labels), bool(info["is_success"]), str(info["unmet"])


def demonstrate_trace(env: BimanualEnv, expert: Demonstrator, seed: int) -> Trace:
    """The expert's episode of this seed, as a trace."""
    expert.reset(seed)
    labels = np.repeat(
        [env.task_spec.labels.index(p.name) for p in env.task_spec.primitives],
        [p.frames for p in env.task_spec.primitives],
    )

    certain = np.eye(len(env.task_spec.labels), dtype=np.float32)

    def act(observation: Observation) -> Move:
        step = expert.act(observation)
        return Move(step.action.astype(np.float32), Belief(step.label, certain[step.label], None, {}))

    return run_episode(env, act, seed, labels)[0]
