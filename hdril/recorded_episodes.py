"""An environment that writes its episodes as Rerun recordings, whoever plays them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from hdril.env import BimanualEnv
from hdril.evaluation import ReferenceCache, judge, keeps
from hdril.rerun_log import write_recording
from hdril.trace import Move, TraceRecorder


class RecordedEpisodes(gym.Wrapper):
    """Writes episodes as Rerun recordings, judged like those of ``hdril-eval``.

    Only episodes whose ``reset`` was given a seed: the expert's episode of the same seed is part of a recording.
    """

    env: BimanualEnv

    def __init__(self, env: BimanualEnv, keep: str, folder: Path) -> None:
        super().__init__(env)
        self._keep, self._folder = keep, folder
        self._references = ReferenceCache(BimanualEnv(env.task))
        self._recorder: TraceRecorder | None = None
        self._seed, self._episode = -1, -1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        observation, info = self.env.reset(seed=seed, options=options)
        self._recorder = None
        if seed is not None:
            self._recorder = TraceRecorder(self.env, observation, info)
            self._seed, self._episode = seed, self._episode + 1
        return observation, info

    def step(self, action):
        result = self.env.step(action)
        if self._recorder is not None:
            observation, reward, terminated, truncated, info = result
            self._recorder.add(Move(np.array(action, np.float32)), observation, float(reward), info)
            if terminated or truncated:
                self._finish(bool(info["is_success"]), str(info["unmet"]))
        return result

    def _finish(self, success: bool, unmet: str) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is None or not keeps(self._keep, self._episode, success):
            return
        reference = self._references.get(self._seed)
        trace = recorder.finish(reference.scripted)
        outcome = judge(self.env.task_spec, self._seed, trace, reference, success, unmet)
        write_recording(self._folder, self.env, outcome, trace, reference)
