"""What a policy learned from: the records that a checkpoint keeps in ``config.json`` under ``training_data``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_policy_hdril.schema import RECIPE_PATH

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

Runs = tuple[tuple[int, int], ...]
"""Ascending numbers as runs, both ends included: 0, 1, 2, 5 is ``((0, 2), (5, 5))``."""


@dataclass(frozen=True)
class TrainingData:
    """One dataset that a policy learned from, and how much of it."""

    digest: str = ""
    """SHA-256 of the content, see :attr:`Demonstrations.digest`; empty: unknown, from before checkpoints kept records."""
    repo_id: str = ""
    task: str | None = None
    """The task that hdril recorded; None for other datasets."""
    recipe: str | None = None
    """SHA-256 of the recipe that hdril recorded with, as canonical JSON; None for other datasets."""
    episodes: Runs = ()
    """Episodes of which the loader gave a frame in training."""
    seeds: Runs | None = None
    """Seeds of these episodes; None where the dataset does not tell them."""
    fitted: int = 0
    """How many of the episodes normalisation, lengths and linear maps are fitted to."""
    quiet: int = 0
    """Training batches since the last new episode, while a fit is due after some more of them."""


@dataclass(frozen=True)
class Origin:
    """What a dataset tells of itself. ``seeds`` are those of its episodes, in order."""

    digest: str
    repo_id: str
    task: str | None = None
    recipe: str | None = None
    seeds: tuple[int, ...] | None = None

    def record(self, episodes: list[int], fitted: int, quiet: int) -> TrainingData:
        """The record of a policy that learned from these episodes."""
        known = self.seeds is not None and all(episode < len(self.seeds) for episode in episodes)
        seeds = to_runs(self.seeds[episode] for episode in episodes) if known and self.seeds is not None else None
        return TrainingData(self.digest, self.repo_id, self.task, self.recipe, to_runs(episodes), seeds, fitted, quiet)


def read_origin(metadata: LeRobotDatasetMetadata, digest: str) -> Origin:
    """Who made the dataset of this digest, as far as its files tell. Raises as :func:`read_told`."""
    recipe, seeds = read_told(Path(metadata.root))
    # Episodes that a tool removed or added would be given seeds of others: then the seeds are unknown.
    if seeds is None or len(seeds) != metadata.total_episodes:
        seeds = None
    return Origin(
        digest,
        metadata.repo_id,
        task=None if recipe is None else recipe.get("task"),
        recipe=None if recipe is None else digest_of_json(recipe),
        seeds=None if seeds is None else tuple(seeds),
    )


def read_told(root: Path) -> tuple[dict[str, Any] | None, list[int] | None]:
    """The recipe and the seeds that hdril wrote into a dataset; None for what is not there.

    Raises:
        ValueError: the file is damaged; names it and the field.
    """
    path = root / RECIPE_PATH
    if not path.exists():
        return None, None
    try:
        told = json.loads(path.read_bytes())
    except ValueError as error:  # of which JSONDecodeError and UnicodeDecodeError are kinds
        raise ValueError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(told, dict):
        raise ValueError(f"{path} must hold a JSON object, not {type(told).__name__}")
    recipe, seeds = told.get("recipe"), told.get("seeds")
    if recipe is not None and not isinstance(recipe, dict):
        raise ValueError(f"{path}: recipe must be an object, not {type(recipe).__name__}")
    if seeds is not None and not (isinstance(seeds, list) and all(type(seed) is int for seed in seeds)):
        raise ValueError(f"{path}: seeds must be a list of integers")
    return recipe, seeds


def digest_of_json(value: Any) -> str:
    """SHA-256 of the canonical JSON: sorted keys, no spaces."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def to_runs(numbers: Iterable[int]) -> Runs:
    """Runs of these numbers, whatever their order."""
    runs: list[tuple[int, int]] = []
    for number in sorted(set(numbers)):
        if runs and runs[-1][1] == number - 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    return tuple(runs)


def from_runs(runs: Runs) -> list[int]:
    """The numbers of these runs, ascending."""
    return [number for first, last in runs for number in range(first, last + 1)]
