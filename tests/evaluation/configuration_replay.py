"""Config of a policy for tests that plays recorded actions, see ``modeling_replay.py``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import AdamConfig, OptimizerConfig


@PreTrainedConfig.register_subclass("replay")
@dataclass
class ReplayConfig(PreTrainedConfig):
    """``primitives`` and ``labels`` say what is played when; ``scale`` is an option that may be overridden."""

    frames: int = 1
    primitives: list[str] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)
    scale: float = 1.0
    training_data: list[dict[str, Any]] = field(default_factory=list)

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> OptimizerConfig:
        return AdamConfig()

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        return None
