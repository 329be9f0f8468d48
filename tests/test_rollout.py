"""The episode loop: what observers see, what an actor's action becomes, and when an episode is over."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from hdril.actor import Decision, Explanation, Observation, ReplayActor
from hdril.env import BimanualEnv
from hdril.rollout import Ending, Transition, run_episode, transitions

EXPLANATION = Explanation(1, np.array([0.0, 1.0], np.float32))


class Countdown:
    """An environment whose observation is the frame. It ends after ``length`` frames, with success or cut."""

    task = "countdown"

    def __init__(self, length: int, success: bool) -> None:
        self.length, self.success, self.frame = length, success, -1
        self.actions: list[np.ndarray] = []

    def _observe(self) -> Observation:
        return {"agent_pos": np.array([self.frame], np.float32)}

    def reset(self, *, seed: int, options: None = None) -> tuple[Observation, dict[str, Any]]:
        self.frame, self.seed, self.actions = 0, seed, []
        return self._observe(), {"frame": 0}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        assert self.frame < self.length, "a step after the end"
        self.frame += 1
        self.actions.append(action)
        over = self.frame == self.length
        success = over and self.success
        info = {"frame": self.frame, "is_success": success, "unmet": "" if success else "table upright, table at rest"}
        return self._observe(), float(success), success, over and not success, info


class Counter:
    """Answers with the frame that it sees, plus a third: not a float32."""

    def reset(self, seed: int) -> None:
        self.seed = seed

    def act(self, observation: Observation) -> Decision:
        return Decision(np.full(16, float(observation["agent_pos"][0]) + 1.0 / 3.0), EXPLANATION)


class Log:
    def __init__(self) -> None:
        self.begun: list[tuple] = []
        self.seen: list[Transition] = []

    def begin(self, env: BimanualEnv, observation: Observation, info: dict[str, Any]) -> None:
        self.begun.append((env, float(observation["agent_pos"][0]), info))

    def observe(self, transition: Transition) -> None:
        self.seen.append(transition)


def play(length: int, success: bool, *observers: Log) -> tuple[Countdown, Counter, Ending]:
    env, actor = Countdown(length, success), Counter()
    return env, actor, run_episode(cast(BimanualEnv, env), actor, 42, *observers)


@pytest.mark.parametrize("success", [True, False])
@pytest.mark.parametrize("length", [1, 5])
def test_observers_see_every_frame_in_order(length: int, success: bool) -> None:
    first, second = Log(), Log()
    env, _, _ = play(length, success, first, second)
    for log in (first, second):
        assert log.begun == [(env, 0.0, {"frame": 0})]
        assert [float(t.observation["agent_pos"][0]) for t in log.seen] == list(range(length))
        assert [float(t.next_observation["agent_pos"][0]) for t in log.seen] == list(range(1, length + 1))
        assert [t.info["frame"] for t in log.seen] == list(range(1, length + 1))
        assert [t.reward for t in log.seen] == [0.0] * (length - 1) + [float(success)]
        assert [t.terminated for t in log.seen] == [False] * (length - 1) + [success]
        assert [t.truncated for t in log.seen] == [False] * (length - 1) + [not success]


def test_actions_are_sent_and_observed_in_single_precision() -> None:
    log = Log()
    env, _, _ = play(3, True, log)
    for frame, (sent, transition) in enumerate(zip(env.actions, log.seen, strict=True)):
        assert sent.dtype == np.float32
        assert transition.decision.action is sent
        np.testing.assert_array_equal(sent, np.float32(frame + 1.0 / 3.0))
        assert transition.decision.explanation is EXPLANATION


def test_environment_and_actor_begin_the_episode_of_the_seed() -> None:
    env, actor, _ = play(2, True)
    assert (env.seed, actor.seed) == (42, 42)


def test_the_ending_says_what_happened() -> None:
    assert play(4, True)[2] == Ending(True, "", 4)
    assert play(6, False)[2] == Ending(False, "table upright, table at rest", 6)


def test_transitions_come_one_by_one() -> None:
    """Whoever takes them may stop early: no further frame is played."""
    env, log = Countdown(5, True), Log()
    stream = transitions(cast(BimanualEnv, env), Counter(), 1, log)
    assert env.frame == -1
    for frame in (1, 2):
        assert next(stream).info["frame"] == env.frame == len(log.seen) == frame
    assert len(list(stream)) == 3


def test_an_actor_that_has_run_out_of_actions_is_an_error() -> None:
    env, actions = Countdown(5, True), np.arange(48.0).reshape(3, 16)
    with pytest.raises(IndexError):
        run_episode(cast(BimanualEnv, env), ReplayActor(actions), 0)
    np.testing.assert_array_equal(np.stack(env.actions), actions)


def test_recorded_actions_are_played_from_the_start_after_a_reset() -> None:
    actor, actions = ReplayActor(np.arange(80.0).reshape(5, 16)), []
    for _ in range(2):
        env = Countdown(5, False)
        assert run_episode(cast(BimanualEnv, env), actor, 0).frames == 5
        actions.append(np.stack(env.actions))
    np.testing.assert_array_equal(*actions)


def test_an_actor_that_gives_up_ends_the_episode_as_a_failure() -> None:
    class GivesUp(Counter):
        def act(self, observation: Observation) -> Decision:
            if observation["agent_pos"][0] == 3:
                raise StopIteration("nothing can be done")
            return super().act(observation)

    log = Log()
    ending = run_episode(cast(BimanualEnv, Countdown(5, success=True)), GivesUp(), 0, log)
    assert ending == Ending(False, "table upright, table at rest", 3)
    assert len(log.seen) == 3


def test_an_actor_that_gives_up_at_once_is_named_with_its_seed() -> None:
    class KnowsNothing(Counter):
        def act(self, observation: Observation) -> Decision:
            raise StopIteration

    with pytest.raises(RuntimeError, match=r"countdown: the actor gave up before the first frame of seed 7"):
        run_episode(cast(BimanualEnv, Countdown(5, success=True)), KnowsNothing(), 7)
