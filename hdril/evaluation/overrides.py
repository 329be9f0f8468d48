"""Which options of a trained policy can change an evaluation."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

ELSEWHERE = frozenset(
    {"push_to_hub", "repo_id", "private", "tags", "license", "pretrained_path", "pretrained_revision"}
)
"""Options of LeRobot's configs that say where a policy goes or came from. They change no action."""
_DECIDED = frozenset({"device", "input_features", "output_features", "normalization_mapping", "training_data"})
"""``device`` is an option of the command. The others are fixed by the weights, the processors' files and the past."""
_TRAINING = frozenset({"kl_weight", "pretrained_backbone_weights", "drop_n_last_frames", "do_mask_loss_for_padding"})
_TRAINING_STARTS = (
    "optimizer_", "scheduler_", "freeze_", "train_", "tune_", "finetune_", "time_sampling_", "lora_",
)  # fmt: skip
_TRAINING_ENDS = ("dropout", "loss_weight", "gradient_checkpointing", "crop_is_random")
"""What the names of LeRobot's options begin and end with that training alone reads."""


def running_options(config_class: type[PreTrainedConfig]) -> list[str]:
    """Names of the options that can change what a trained policy does, sorted.

    A config class may list them itself, as ``running_options``; then these are all. Of any other policy, options are left out
    that are known to have no effect; whether each of the rest has one, only the policy knows.
    """
    declared = getattr(config_class, "running_options", None)
    if declared is not None:
        return sorted(declared)
    names = {entry.name for entry in fields(config_class)} - ELSEWHERE - _DECIDED - _TRAINING - _inherited(config_class)
    return sorted(name for name in names if not name.startswith(_TRAINING_STARTS) and not name.endswith(_TRAINING_ENDS))


def _inherited(config_class: type[PreTrainedConfig]) -> set[str]:
    """Options of LeRobot's base class that the policy does not declare anew: those that act, such as ``n_obs_steps`` of
    diffusion policies, it does."""
    from lerobot.configs.policies import PreTrainedConfig

    own = {
        name for kind in config_class.__mro__ if kind not in PreTrainedConfig.__mro__ for name in kind.__annotations__
    }
    return {entry.name for entry in fields(PreTrainedConfig)} - own
