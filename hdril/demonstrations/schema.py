"""The schema of a dataset (LeRobot v3.0): columns, files beside them, and what their numbers are called.

Whoever writes or reads a dataset of demonstrations takes the names from here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hdril.demonstrations.provenance import RECIPE_PATH, Recipe
from hdril.simulation.actions import ACTION_NAMES
from hdril.tasks import get_task

STATE = "observation.state"
"""(16,): measured hand poses and openings, :data:`~hdril.simulation.actions.ACTION_NAMES`."""
ENVIRONMENT_STATE = "observation.environment_state"
"""Poses of the observed objects, 7 numbers each, named ``<object>.<axis>``; where scenes vary, also the objects' attributes,
named ``<object>.<attribute>``."""
ACTION = "action"
"""(16,): commanded hand poses and openings, named as :data:`STATE`."""
SUBTASK = "subtask_index"
"""Label of a frame: the primitive that the expert executes, an index into :data:`SUBTASKS_PATH`."""
SUBTASK_START = "subtask_start"
"""Whether a primitive starts at this frame: tells a primitive that is played twice from one that goes on."""
LANGUAGE = "language_persistent"
"""LeRobot's column of language: in every frame all rows of the episode, see :mod:`hdril.demonstrations.labels`."""
REWARD, SUCCESS, DONE = "next.reward", "next.success", "next.done"
SEED = "seed"
"""Column of ``meta/episodes``: the seed of the episode."""
SCENARIO = "scenario"
"""Column of ``meta/episodes``: the scene and its events, as JSON (:class:`hdril.tasks.scenario.Scenario`)."""
DIGEST = "digest"
"""Column of ``meta/episodes``: :func:`hdril.demonstrations.content.episode_digest`."""

SUBTASKS_PATH = "meta/subtasks.parquet"
"""Names of the primitives, by label."""
PROPORTIONS_PATH = "meta/temporal_proportions_dense.json"
"""Share of each primitive in an episode, for LeRobot's SARM."""

__all__ = [
    "ACTION",
    "DIGEST",
    "DONE",
    "ENVIRONMENT_STATE",
    "LANGUAGE",
    "PROPORTIONS_PATH",
    "RECIPE_PATH",
    "REWARD",
    "SCENARIO",
    "SEED",
    "STATE",
    "SUBTASK",
    "SUBTASKS_PATH",
    "SUBTASK_START",
    "SUCCESS",
    "features",
    "features_of",
]


def features(recipe: Recipe) -> dict[str, dict[str, Any]]:
    """Features of a dataset of this recipe, as LeRobot declares them."""
    return features_of(get_task(recipe.task).state_names)


def features_of(state_names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Features of a dataset whose :data:`ENVIRONMENT_STATE` has numbers of these names."""

    def vector(names: Sequence[str]) -> dict[str, Any]:
        return {"dtype": "float32", "shape": (len(names),), "names": list(names)}

    def scalar(dtype: str) -> dict[str, Any]:
        return {"dtype": dtype, "shape": (1,), "names": None}

    return {
        STATE: vector(ACTION_NAMES),
        ENVIRONMENT_STATE: vector(state_names),
        ACTION: vector(ACTION_NAMES),
        SUBTASK: scalar("int64"),
        SUBTASK_START: scalar("bool"),
        REWARD: scalar("float32"),
        SUCCESS: scalar("bool"),
        DONE: scalar("bool"),
    }
