"""One demonstration, as an observer of the episode loop collects it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Actor, Observation
from hdril.env import BimanualEnv
from hdril.rollout import Transition, run_episode


@dataclass(frozen=True)
class Episode:
    """One demonstration of T frames, float32, and how it ended (``unmet``: conditions of success that do not hold)."""

    seed: int
    state: NDArray[np.float32]  # (T, 16)
    environment_state: NDArray[np.float32]  # (T, 7 per object)
    action: NDArray[np.float32]  # (T, 16)
    label: NDArray[np.int64]  # (T,)
    start: NDArray[np.bool_]  # (T,), whether a primitive starts at this frame
    reward: NDArray[np.float32]  # (T,)
    success: bool
    unmet: str
    scenario: str
    """The scene and what happened to it, as JSON (:class:`hdril.tasks.scenario.Scenario`)."""

    def __len__(self) -> int:
        return len(self.action)


class EpisodeRecorder:
    """An observer that keeps what a dataset stores of each frame."""

    def begin(self, env: BimanualEnv, observation: Observation, info: dict[str, Any]) -> None:
        self._transitions: list[Transition] = []
        self._scenario = env.scenario.to_json()

    def observe(self, transition: Transition) -> None:
        """Add a frame."""
        self._transitions.append(transition)

    def episode(self, seed: int) -> Episode:
        """The episode, which is over and was of this seed.

        Raises:
            ValueError: the actor does not say which primitive it executes.
        """
        explanations = [t.decision.explanation for t in self._transitions]
        if any(explanation is None for explanation in explanations):
            raise ValueError("a demonstration needs an actor that explains which primitive it executes")
        last = self._transitions[-1].info
        return Episode(
            seed=seed,
            state=np.stack([t.observation["agent_pos"] for t in self._transitions]),
            environment_state=np.stack([t.observation["environment_state"] for t in self._transitions]),
            action=np.stack([t.decision.action for t in self._transitions]),
            label=np.array([e.primitive for e in explanations if e is not None], np.int64),
            start=np.array([e.starts for e in explanations if e is not None]),
            reward=np.array([t.reward for t in self._transitions], np.float32),
            success=bool(last["is_success"]),
            unmet=str(last["unmet"]),
            scenario=self._scenario,
        )


def demonstrate(env: BimanualEnv, expert: Actor, seed: int) -> Episode:
    """Run the expert once, on the scene of ``seed``."""
    recorder = EpisodeRecorder()
    run_episode(env, expert, seed, recorder)
    return recorder.episode(seed)
