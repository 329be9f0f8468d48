"""hdril as a library: play the expert, watch it, record it, train a policy on it, and evaluate the policy.

python docs/tutorials/library.py FOLDER
"""

# ruff: noqa: E402 (each part of the tutorial imports what it needs)
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import torch

# [1: an environment]
from hdril.env import BimanualEnv

env = BimanualEnv("table_lift")
observation, info = env.reset(seed=7)
print("the hands:", observation["agent_pos"].shape, "the table:", observation["environment_state"].shape)

# [2: an observer of your own]
from hdril.actor import Observation
from hdril.rollout import Transition, run_episode
from hdril.tasks.expert import ScriptedExpert


class HighestPoint:
    """Watches an episode, and remembers how high the table was lifted, m."""

    def begin(self, env: BimanualEnv, observation: Observation, info: dict) -> None:
        self.height = 0.0

    def observe(self, transition: Transition) -> None:
        _, _, z, *_ = transition.next_observation["environment_state"]
        self.height = max(self.height, float(z))


highest = HighestPoint()
ending = run_episode(env, ScriptedExpert(env.task_spec), 7, highest)
print(f"success: {ending.success}, after {ending.frames} frames; the table rose to {100 * highest.height:.0f} cm")
env.close()

# [3: six demonstrations]
from hdril.demonstrations.provenance import Recipe
from hdril.demonstrations.record import record

folder = Path(sys.argv[1])
recording = record(Recipe("table_lift"), num_episodes=6, first_seed=0, root=folder / "dataset")
print("recorded the seeds", recording.seeds)

# [4: the dataset, with LeRobot]
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("local/table_lift", root=folder / "dataset")
frame = dataset[0]
print(
    len(dataset),
    "frames; an action has",
    len(frame["action"]),
    "numbers; it is of primitive",
    int(frame["subtask_index"]),
)

# [5: a policy, from LeRobot's factory]
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
torch.manual_seed(0)
policy = make_policy(make_policy_config("hdril", device="cpu", push_to_hub=False), ds_meta=dataset.meta)
before, after = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)

# [6: a training loop]
optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
policy.train()
losses = []
loader = torch.utils.data.DataLoader(dataset, batch_size=8, shuffle=True)
for batch in islice(loader, 40):
    loss, _ = policy.forward(before(batch))
    loss.backward()
    optimizer.step()
    optimizer.zero_grad()
    losses.append(loss.item())
print(f"loss: {np.mean(losses[:5]):.2f} at first, {np.mean(losses[-5:]):.2f} at last")

checkpoint = folder / "checkpoint"
policy.save_pretrained(checkpoint)
before.save_pretrained(checkpoint)
after.save_pretrained(checkpoint)

# [7: an evaluation on two seeds]
from hdril.evaluation.evaluate import evaluate, make_job

job = make_job("table_lift", str(checkpoint), first_seed=100_000, num_episodes=2)
for outcome in evaluate(job, job.seeds):
    print(f"seed {outcome.seed}: success {outcome.success}, played {', '.join(outcome.primitives)}")
    print(
        f"    on average {outcome.position_error_cm:.1f} cm from the expert's hands; {outcome.unmet or 'nothing is amiss'}"
    )
