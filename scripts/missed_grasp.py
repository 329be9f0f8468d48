"""What a policy does when its first grasp comes to nothing.

python scripts/missed_grasp.py --policy=outputs/table_lift/train/checkpoints/last/pretrained_model

While the policy plays its first primitive, something else is done than it says: the hands stay where they are, or the fingers
stay open, or the hands arrive too high. Afterwards it is on its own, for three times the task's length.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hdril.control import ACTION_NAMES
from hdril.env import BimanualEnv
from hdril.evaluation import LeRobotActor
from hdril.statistics import wilson_interval
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", required=True, help="a checkpoint with primitives (--policy.type=hdril)")
    parser.add_argument("--task", default="table_lift")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=700_000)
    options = parser.parse_args()
    task = get_task(options.task)
    env, actor = BimanualEnv(options.task, max_episode_steps=3 * task.horizon), LeRobotActor(options.policy, task)
    for name, mishap in MISHAPS.items():
        again = successes = 0
        for seed in range(options.seed, options.seed + options.episodes):
            observation, info = env.reset(seed=seed)
            actor.reset(seed)
            start, played = observation["agent_pos"].copy(), []
            done = False
            while not done:
                move = actor.act(observation)
                if move.belief is None:
                    parser.error(f"{options.policy} has no primitives")
                played.append(move.belief.primitive)
                missed = len(played) <= task.primitives[0].frames
                observation, _, terminated, truncated, info = env.step(
                    mishap(move.action, start) if missed else move.action
                )
                done = terminated or truncated
            again += played[task.primitives[0].frames] == played[0]
            successes += bool(info["is_success"])
        low, high = wilson_interval(successes, options.episodes)
        print(f"{name}: tried again at once in {again}, succeeded in {successes} of {options.episodes} "
              f"({100 * low:.0f} to {100 * high:.0f} %)", flush=True)  # fmt: skip
    env.close()


if __name__ == "__main__":
    main()
