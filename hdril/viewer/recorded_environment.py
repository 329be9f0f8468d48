"""An environment that writes its episodes as Rerun recordings, whoever plays them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from hdril.actor import Decision, Observation
from hdril.env import BimanualEnv
from hdril.evaluation.evaluate import EvaluatedEpisode
from hdril.evaluation.reference import ReferenceCache
from hdril.evaluation.score import score_episode
from hdril.rollout import Ending, Transition
from hdril.trace import TraceRecorder
from hdril.viewer.keep import keeps
from hdril.viewer.recordings import write_recording


class RecordedEpisodes(gym.Wrapper[Observation, NDArray[np.floating], Observation, NDArray[np.floating]]):
    """Writes episodes as Rerun recordings, judged like those of ``hdril-eval``.

    Only episodes whose ``reset`` was given a seed: the expert's episode of the same seed is part of a recording.
    """

    def __init__(self, env: BimanualEnv, keep: str, folder: Path) -> None:
        super().__init__(env)
        self._env = env
        self._keep, self._folder = keep, folder
        self._references = ReferenceCache(env.task)
        self._recorder: TraceRecorder | None = None
        self._seed, self._episode = -1, -1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        observation, info = self.env.reset(seed=seed, options=options)
        self._recorder, self._observation = None, observation
        if seed is not None:
            self._recorder = TraceRecorder()
            self._recorder.begin(self._env, observation, info)
            self._seed, self._episode = seed, self._episode + 1
        return observation, info

    def step(self, action):
        result = self.env.step(action)
        if self._recorder is not None:
            observation, reward, terminated, truncated, info = result
            decision = Decision(np.array(action, np.float32))
            self._recorder.observe(
                Transition(self._observation, decision, observation, float(reward), terminated, truncated, info)
            )
            self._observation = observation
            if terminated or truncated:
                self._finish(Ending(bool(info["is_success"]), str(info["unmet"]), self._env.frame))
        return result

    def _finish(self, ending: Ending) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is None or not keeps(self._keep, self._episode, ending.success):
            return
        reference = self._references.get(self._seed)
        trace = recorder.trace(reference.scripted)
        outcome = score_episode(self._env.task_spec, self._seed, trace, reference, ending)
        write_recording(self._folder, EvaluatedEpisode(self._env, outcome, trace, reference))
