"""What a demonstration keeps of each frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hdril.actor import Decision, Explanation, ReplayActor
from hdril.demonstrations.episode import demonstrate
from hdril.tasks.scenario import Scenario


class Counter:
    """Stands in for an environment of three frames: it shows how often it was stepped."""

    def _observation(self):
        return {
            "agent_pos": np.full(16, self.steps, np.float32),
            "environment_state": np.full(7, -self.steps, np.float32),
        }

    def reset(self, *, seed: int, options: None = None):
        self.seed, self.steps = seed, 0
        self.scenario = Scenario("count", seed, {}, {})
        return self._observation(), {}

    def step(self, action):
        self.steps += 1
        last = self.steps == 3
        info = {"is_success": False, "unmet": f"condition {self.steps}"}
        return self._observation(), 0.5 * self.steps, False, last, info


class Counting:
    """Stands in for an expert: action 10, 11, 12 of primitives 2, 3, 4."""

    def reset(self, seed: int) -> None:
        self.seed, self.calls = seed, -1

    def act(self, observation) -> Decision:
        self.calls += 1
        return Decision(np.full(16, 10.0 + self.calls), Explanation(2 + self.calls, np.zeros(6, np.float32)))


def test_a_frame_is_what_was_seen_before_the_action_and_the_reward_after_it() -> None:
    env: Any = Counter()
    expert = Counting()
    episode = demonstrate(env, expert, 42)
    assert env.seed == expert.seed == episode.seed == 42
    assert episode.state[:, 0].tolist() == [0, 1, 2]
    assert episode.environment_state[:, 0].tolist() == [0, -1, -2]
    assert episode.action[:, 0].tolist() == [10, 11, 12]
    assert episode.label.tolist() == [2, 3, 4]
    assert episode.reward.tolist() == [0.5, 1.0, 1.5]
    assert not episode.success
    assert episode.unmet == "condition 3"
    assert len(episode) == 3
    assert (episode.state.dtype, episode.action.dtype, episode.label.dtype) == (np.float32, np.float32, np.int64)


def test_an_actor_without_primitives_cannot_demonstrate() -> None:
    env: Any = Counter()
    with pytest.raises(ValueError, match="an actor that explains which primitive"):
        demonstrate(env, ReplayActor(np.zeros((3, 16))), 0)
