"""Checkpoints for tests: folders as LeRobot saves them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import AddBatchDimensionProcessorStep, DeviceProcessorStep, PolicyProcessorPipeline
from lerobot_policy_hdril import HDRILConfig
from numpy.typing import NDArray

from hdril.env import BimanualEnv
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.trace import Trace, trace_episode
from tests.evaluation.configuration_replay import ReplayConfig
from tests.evaluation.modeling_replay import ReplayPolicy


def experts_episode(seed: int, task: str = "table_lift") -> Trace:
    """The noise-free expert on a seed."""
    env = BimanualEnv(task)
    trace, _ = trace_episode(env, ScriptedExpert(env.task_spec, Noise(0.0)), seed)
    env.close()
    return trace


def save_replay(folder: Path, actions: NDArray, **config: Any) -> Path:
    """A checkpoint of a policy that plays ``actions`` (T, 16)."""
    policy = ReplayPolicy(ReplayConfig(device="cpu", push_to_hub=False, frames=len(actions), **config))
    policy.actions.copy_(torch.as_tensor(actions))
    policy.save_pretrained(folder)
    steps = [AddBatchDimensionProcessorStep(), DeviceProcessorStep(device="cpu")]
    PolicyProcessorPipeline(steps, name="policy_preprocessor").save_pretrained(folder)
    PolicyProcessorPipeline([], name="policy_postprocessor").save_pretrained(folder)
    return folder


def save_stock(folder: Path, policy: PreTrainedPolicy, metadata: LeRobotDatasetMetadata, root: str | None) -> Path:
    """A checkpoint as ``lerobot-train`` leaves it; ``root`` is what training was told of the dataset's folder."""
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=metadata.stats):
        processor.save_pretrained(folder)
    TrainPipelineConfig(DatasetConfig("hdril/test", root=root), policy=policy.config).save_pretrained(folder)
    return folder


def save_hdril(
    folder: Path, dataset: Path, episodes: tuple[int, ...] = (0, 1, 2, 3, 4, 5), preset: str = "hdril"
) -> Path:
    """HDR-IL that saw one frame of each of these episodes: what is solved is solved, and nothing else is trained."""
    metadata = LeRobotDatasetMetadata("hdril/test", root=dataset)
    torch.manual_seed(0)
    policy = make_policy(HDRILConfig(device="cpu", push_to_hub=False, preset=preset), ds_meta=metadata)
    starts = metadata.episodes["dataset_from_index"]
    policy.train()
    policy.forward({"index": torch.tensor([starts[episode] for episode in episodes])})
    return save_stock(folder, policy, metadata, str(dataset))


def save_act(folder: Path, dataset: Path, root: str | None, **options: Any) -> Path:
    """A small ACT without training."""
    metadata = LeRobotDatasetMetadata("hdril/test", root=dataset)
    torch.manual_seed(0)
    config = ACTConfig(
        device="cpu", push_to_hub=False, dim_model=32, n_heads=2, dim_feedforward=32, latent_dim=4, n_encoder_layers=1,
        n_vae_encoder_layers=1, chunk_size=10, n_action_steps=10, **options,
    )  # fmt: skip
    return save_stock(folder, make_policy(config, ds_meta=metadata), metadata, root)


def listing(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, with its content; folders as well, with none."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in sorted(folder.rglob("*"))}
