"""What a policy does when its first grasp comes to nothing.

python scripts/missed_grasp.py --policy=outputs/table_lift/train/checkpoints/last/pretrained_model

While the policy plays its first primitive, its actions are changed: the hands stay where they are, or the fingers stay open, or
the hands arrive too high. From then on its actions are left as they are. An episode lasts three times the task's horizon. The
intervals are of one trained policy.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hdril.actor import Decision, Observation
from hdril.env import BimanualEnv
from hdril.evaluation.lerobot_actor import LeRobotActor
from hdril.evaluation.statistics import wilson_interval
from hdril.rollout import run_episode
from hdril.simulation.actions import ACTION_NAMES
from hdril.tasks import get_task

Action = NDArray[np.float32]
FINGERS = [i for i, name in enumerate(ACTION_NAMES) if name.endswith("gripper.pos")]
HEIGHTS = [i for i, name in enumerate(ACTION_NAMES) if name.endswith(".z")]


def _changed(action: Action, columns: list[int], values: float | Action) -> Action:
    result = action.copy()
    result[columns] = values
    return result


MISHAPS: dict[str, Callable[[Action, Action], Action]] = {
    "the hands stay where they are": lambda action, start: start,
    "the fingers stay open": lambda action, start: _changed(action, FINGERS, 1.0),
    "the hands arrive 6 cm too high": lambda action, start: _changed(action, HEIGHTS, action[HEIGHTS] + 0.06),
}


class Mishap:
    """A policy whose actions are changed by ``spoil(action, first state)`` during the first ``frames`` frames."""

    def __init__(self, policy: LeRobotActor, spoil: Callable[[Action, Action], Action], frames: int) -> None:
        self._policy, self._spoil, self._frames = policy, spoil, frames

    def reset(self, seed: int) -> None:
        self._policy.reset(seed)
        self._start: Action | None = None
        self.executed: list[int] = []
        """Labels of the primitives that the policy executed, frame by frame."""

    def act(self, observation: Observation) -> Decision:
        decision = self._policy.act(observation)
        if decision.explanation is None:
            raise ValueError("the policy has no primitives")
        start = observation["agent_pos"].copy() if self._start is None else self._start
        self._start = start
        self.executed.append(decision.explanation.primitive)
        if len(self.executed) > self._frames:
            return decision
        return Decision(self._spoil(np.asarray(decision.action, np.float32), start), decision.explanation)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", required=True, help="a checkpoint with primitives (--policy.type=hdril)")
    parser.add_argument("--task", default="table_lift")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=700_000)
    options = parser.parse_args()
    task = get_task(options.task)
    env, policy = BimanualEnv(options.task, max_episode_steps=3 * task.horizon), LeRobotActor(options.policy, task)
    first = task.primitives[0].frames
    for name, spoil in MISHAPS.items():
        again = successes = 0
        actor = Mishap(policy, spoil, first)
        for seed in range(options.seed, options.seed + options.episodes):
            successes += run_episode(env, actor, seed).success
            again += actor.executed[first] == actor.executed[0]
        low, high = wilson_interval(successes, options.episodes)
        print(f"{name}: tried again at once in {again}, succeeded in {successes} of {options.episodes} "
              f"(95 % interval {100 * low:.0f} to {100 * high:.0f} %)", flush=True)  # fmt: skip
    env.close()


if __name__ == "__main__":
    main()
