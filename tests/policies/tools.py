"""What the tests of the policy share: small policies, and datasets that are a little different."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy
from lerobot_policy_hdril.demonstrations import Demonstrations
from lerobot_policy_hdril.presets import PRESETS

FRAMES = 70
"""Of each of the six episodes."""
STARTS = [0, 10, 22, 34, 46, 58]
"""First frames of the primitives in an episode."""
BATCH = torch.tensor([FRAMES * episode + start for start in STARTS for episode in range(6)])
"""``index`` of a training batch: the start of each primitive in each episode."""
SMALL: dict[str, Any] = {
    "device": "cpu",
    "push_to_hub": False,
    "hidden_dim": 32,
    "node_dim": 8,
    "planner_hidden_dim": 16,
    "optimizer_lr": 1e-2,
}
VARIANTS: dict[str, dict[str, Any]] = {name: {"preset": name, "hidden_dim": 32} for name in PRESETS} | {
    "replanning": {"replan_every": 4},
    "ODE": {"decoder": "ode"},
    "variational": {"latent": "variational", "kl_weight": 1e-3, "state_skip": False},
    "relational": {"coordinates": "relational"},
}


def read(root: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata("hdril/test", root=root)


def build(metadata: LeRobotDatasetMetadata, learned: bool = True, **values: Any) -> HDRILPolicy:
    """A small policy, the preset ``hdril`` but for these values; ``learned`` shows it a frame of every episode, so that its
    statistics and linear maps are fitted."""
    torch.manual_seed(0)
    plain = {} if "preset" in values else PRESETS["hdril"]
    policy = make_policy(HDRILConfig(**plain | SMALL | values), ds_meta=metadata)
    assert isinstance(policy, HDRILPolicy)
    if learned:
        data = demonstrations(policy)
        policy.forward({"index": data.index[data.episode.diff(prepend=torch.tensor([-1])) != 0]})
        torch.manual_seed(0)
    return policy


def demonstrations(policy: HDRILPolicy) -> Demonstrations:
    assert policy._demonstrations is not None
    return policy._demonstrations


def observation(metadata: LeRobotDatasetMetadata, frames: list[int]) -> dict[str, torch.Tensor]:
    files = sorted((Path(metadata.root) / "data").glob("*/*.parquet"))
    columns = _observations(tuple((str(file), file.stat().st_mtime_ns) for file in files))
    return {key: values[frames] for key, values in columns.items()}


@lru_cache(maxsize=4)
def _observations(files: tuple[tuple[str, int], ...]) -> dict[str, torch.Tensor]:
    """The columns of these files, by the time of their last change."""
    data = pd.concat([pd.read_parquet(name) for name, _ in files])
    return {
        key: torch.from_numpy(np.stack(list(data[key])))
        for key in ("observation.state", "observation.environment_state")
    }


def edit(root: Path, key: str, change: Callable[[int, int, Any], Any], kind: pa.DataType | None = None) -> None:
    """Rewrite a column: ``change(episode, frame, value)`` gives the new value, of the same type unless another is given."""
    for file in (root / "data").glob("*/*.parquet"):
        table = pq.read_table(file)
        columns = (table[name].to_pylist() for name in ("episode_index", "frame_index", key))
        values = [change(*row) for row in zip(*columns, strict=True)]
        at = table.column_names.index(key)
        pq.write_table(table.set_column(at, key, pa.array(values, kind or table[key].type)), file)


def vary_lengths(root: Path) -> Path:
    """Relabel a dataset, so that primitives are one to three frames longer in some episodes than in others."""
    shifted = {e: [s + ((e + 2 * i) % 4 if i else 0) for i, s in enumerate(STARTS)] for e in range(6)}
    edit(root, "subtask_index", lambda episode, frame, _: int(np.searchsorted(shifted[episode], frame, "right")) - 1)
    edit(root, "subtask_start", lambda episode, frame, _: frame in shifted[episode])
    return root


def tensors(policy: HDRILPolicy) -> dict[str, torch.Tensor]:
    """Weights and buffers, also those that are not saved."""
    return {**policy.state_dict(), **dict(policy.named_buffers())}


def assert_same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    """Bit for bit."""
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]), name


class Training:
    """Policy, optimiser and schedule, as LeRobot's trainer has them."""

    def __init__(self, policy: HDRILPolicy, steps: int = 100) -> None:
        self.policy = policy.train()
        self.optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
        self.scheduler = policy.config.get_scheduler_preset().build(self.optimizer, steps)

    def step(self, index: torch.Tensor) -> tuple[float, dict[str, float]]:
        self.policy.train()
        loss, info = self.policy.forward({"index": index})
        loss.backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.scheduler.step()
        return loss.item(), info
