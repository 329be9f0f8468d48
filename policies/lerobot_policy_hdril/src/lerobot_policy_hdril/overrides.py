"""What of a checkpoint's config may change after training, and what its weights have fixed."""

from __future__ import annotations

from dataclasses import fields

from lerobot.configs.policies import PreTrainedConfig

from lerobot_policy_hdril.configuration_hdril import HDRILConfig

# What further training reads. The fit of a checkpoint is not made anew: what decides it is fixed.
_TRAINING = {
    "kl_weight",
    "state_loss_weight",
    "planner_balance",
    "planner_batch_size",
    "planner_dropout",
    "planner_late",
    "subtask_key",
    "optimizer_lr",
    "optimizer_weight_decay",
    "optimizer_grad_clip_norm",
    "scheduler_warmup_share",
    "scheduler_final_lr",
}
# LeRobot's own: device, repository, features (which it fills in by itself) and the like.
_LEROBOT = {entry.name for entry in fields(PreTrainedConfig)}
CHANGEABLE = frozenset(HDRILConfig.running_options | _TRAINING | _LEROBOT)
"""Fields of :class:`HDRILConfig` that an override of a checkpoint may change. ``replan_every`` has limits of its own."""


def check_overrides(given: HDRILConfig, saved: HDRILConfig, checkpoint: str) -> None:
    """Compare a config with the one that a checkpoint was saved with.

    Raises:
        ValueError: a field differs that the weights have fixed. Weights that do not fit would be left out by LeRobot, with
            random ones in their place.
    """
    for entry in fields(saved):
        ours, theirs = getattr(given, entry.name), getattr(saved, entry.name)
        if entry.name not in CHANGEABLE and ours != theirs:
            raise ValueError(
                f"policy.{entry.name} is {theirs!r} in the checkpoint {checkpoint}, and its weights have fixed that; "
                f"got {ours!r}"
            )
