"""Processors around HDR-IL: LeRobot's defaults. The model normalises by itself (see ``normalization_mapping``)."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline
from lerobot.processor.factory import make_default_pre_post_processors

from lerobot_policy_hdril.configuration_hdril import HDRILConfig


def make_hdril_pre_post_processors(
    config: HDRILConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Batching and device placement before the policy; back to the CPU after it."""
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
