"""The episode loop: an actor on an environment, watched by observers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from hdril.actor import Actor, Decision, Observation, Privileged
from hdril.env import BimanualEnv
from hdril.tasks.scenario import Scenario


@dataclass(frozen=True)
class Transition:
    """One frame of an episode: what was seen, what was done, and what ``step`` returned."""

    observation: Observation
    decision: Decision
    """Action and ``sent`` are float32, as datasets store them."""
    next_observation: Observation
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class Observer(Protocol):
    """Watches an episode. It must not change the environment."""

    def begin(self, env: BimanualEnv, observation: Observation, info: dict[str, Any]) -> None:
        """An episode has been reset; ``observation`` and ``info`` are what ``reset`` returned."""
        ...

    def observe(self, transition: Transition) -> None:
        """A frame is over."""
        ...


@dataclass(frozen=True)
class Ending:
    """How an episode ended: whether it succeeded, the conditions of success that do not hold, and its frames."""

    success: bool
    unmet: str
    frames: int


def transitions(
    env: BimanualEnv, actor: Actor, seed: int, *observers: Observer, scenario: Scenario | None = None
) -> Iterator[Transition]:
    """Play the scene of ``seed`` frame by frame, until the environment terminates or truncates the episode.

    An actor that raises StopIteration knows nothing more to do: the episode ends there, as a failure.

    ``scenario`` is played instead of the one that the environment samples from the seed, such as its control without events.

    Raises:
        RuntimeError: the actor knows nothing to do at the first frame.
    """
    observation, info = env.reset(seed=seed, options=None if scenario is None else {"scenario": scenario})
    actor.reset(seed)
    for observer in observers:
        observer.begin(env, observation, info)
    over = False
    while not over:
        try:
            decision = actor.act(env.exact_observation() if isinstance(actor, Privileged) else observation)
        except StopIteration:
            if env.frame == 0:
                raise RuntimeError(f"{env.task}: the actor gave up before the first frame of seed {seed}") from None
            return
        # float32 is what a dataset stores: an episode can be played again from its recorded actions.
        action = np.asarray(decision.action, np.float32)
        sent = action if decision.sent is None else np.asarray(decision.sent, np.float32)
        decision = Decision(action, decision.explanation, sent)
        following, reward, terminated, truncated, info = env.step(sent)
        transition = Transition(observation, decision, following, float(reward), terminated, truncated, info)
        for observer in observers:
            observer.observe(transition)
        yield transition
        observation, over = following, terminated or truncated


def run_episode(
    env: BimanualEnv, actor: Actor, seed: int, *observers: Observer, scenario: Scenario | None = None
) -> Ending:
    """Play the scene of ``seed``, or a scenario (see :func:`transitions`), to its end."""
    frames, info = 0, {}
    for transition in transitions(env, actor, seed, *observers, scenario=scenario):
        frames, info = frames + 1, transition.info
    return Ending(bool(info["is_success"]), str(info["unmet"]), frames)
