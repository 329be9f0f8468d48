"""Processors around the nearest demonstration: LeRobot's defaults."""

from __future__ import annotations

from lerobot_policy_hdril.processor_hdril import make_hdril_pre_post_processors

make_nearest_pre_post_processors = make_hdril_pre_post_processors
"""LeRobot looks for the processors of a type by this name."""
