"""Whether seeds were in the data that a policy was trained on: known from records, or said to be unknown; never guessed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hdril.demonstrations.provenance import RECIPE_PATH
from hdril.digest import SHORT, digest_json
from hdril.evaluation.checkpoint import TRAINING, Checkpoint, read_json
from hdril.tasks import base_name

STATISTICS = "meta/stats.json"
"""Where a LeRobot dataset keeps the statistics of its columns."""
_CLOSE = 1e-6
"""Relative and absolute difference of statistics of the same data: a checkpoint has them in float32."""


@dataclass(frozen=True)
class TrainingSeeds:
    """The seeds of a data set that a policy learned from."""

    task: str | None
    """None: hdril does not know the task."""
    seeds: frozenset[int]
    recipe: str
    """SHA-256 of the recipe; empty if there is none."""


@dataclass(frozen=True)
class HeldOut:
    """Whether the seeds of an evaluation are known to be apart from the training data, and from what.

    ``known`` is True or None: seeds that are known to be in the training data are refused.
    """

    known: bool | None
    basis: str
    """What the seeds were compared with, or why there is no telling: a phrase."""


def check_held_out(
    checkpoint: Checkpoint, task: str, seeds: Sequence[int], training_data: Path | None = None
) -> HeldOut:
    """Compare the seeds of an evaluation with those of the training data.

    A checkpoint of hdril records what it learned from. Of any other, the data set is looked for where ``train_config.json``
    says, and taken only if its statistics are those in the checkpoint's processors; all its seeds count as used.

    Args:
        checkpoint: the policy.
        task: of the evaluation.
        seeds: of the evaluation.
        training_data: the data set, named by hand; for checkpoints that have no record of it.

    Raises:
        ValueError: the policy was trained on some of the seeds, or on another task, or ``training_data`` are not what it was
            trained on.
    """
    records = checkpoint.read_config().get("training_data") or []
    if records:
        if training_data is not None:
            raise ValueError(f"{checkpoint.name} records what it was trained on: leave out training_data")
        known, basis = _recorded(records)
    else:
        known, basis = _from_dataset(checkpoint, training_data)
    _check_seeds(known, task, seeds)
    return HeldOut(True if known and not basis else None, basis or _describe(known))


def _describe(known: list[TrainingSeeds]) -> str:
    recipes = sorted({entry.recipe[:SHORT] for entry in known if entry.recipe})
    plural = "s" if len(recipes) > 1 else ""
    return f"compared with the seeds of the training data, recipe{plural} {', '.join(recipes)}"


def _recorded(records: list[dict[str, Any]]) -> tuple[list[TrainingSeeds], str]:
    """What the checkpoint records, and why that is not all, if it is not."""
    known = [
        TrainingSeeds(record.get("task"), frozenset(_numbers(record["seeds"])), record.get("recipe") or "")
        for record in records
        if record.get("digest") and record.get("seeds") is not None
    ]
    complete = len(known) == len(records)
    return known, "" if complete else "the checkpoint has no record of the seeds of all its training data"


def _numbers(runs: list[list[int]]) -> Iterator[int]:
    for first, last in runs:
        yield from range(first, last + 1)


def _from_dataset(checkpoint: Checkpoint, training_data: Path | None) -> tuple[list[TrainingSeeds], str]:
    """The seeds of the data set that the checkpoint was trained on, and why they are not known, if they are not."""
    if base := checkpoint.read_config().get("pretrained_path"):
        # LeRobot puts the statistics of the last data set in place of those of the first.
        return [], f"training went on from {base}, and what that had been trained on is not recorded"
    if training_data is not None:
        if reason := _mismatch(checkpoint, training_data):
            raise ValueError(f"{training_data} is not the data set that {checkpoint.name} was trained on: {reason}")
        root = training_data
    else:
        root = find_training_data(checkpoint)
    if root is None:
        return [], "the training data are not at hand, or are not what the checkpoint was trained on"
    return _seeds_of(root)


def find_training_data(checkpoint: Checkpoint) -> Path | None:
    """The data set that ``train_config.json`` names, if it is here and has the statistics that the checkpoint keeps."""
    return next((root for root in _candidates(checkpoint) if not _mismatch(checkpoint, root)), None)


def _seeds_of(root: Path) -> tuple[list[TrainingSeeds], str]:
    """What a data set tells of its seeds, whatever version of hdril recorded it; and why it tells nothing, if so.

    Only these fields of ``meta/hdril.json`` are read: a recipe that this version cannot play is a recipe all the same.
    """
    path = root / RECIPE_PATH
    if not path.is_file():
        return [], "the training data have no record of seeds"
    told = read_json(path)
    seeds, recipe = told.get("seeds"), told.get("recipe")
    if not isinstance(seeds, list) or not seeds or not all(type(seed) is int for seed in seeds):
        return [], f"{RECIPE_PATH} of the training data has no list of seeds"
    if not isinstance(recipe, dict) or not isinstance(recipe.get("task"), str):
        return [], f"{RECIPE_PATH} of the training data does not name the task of its seeds"
    return [TrainingSeeds(recipe["task"], frozenset(seeds), digest_json(recipe))], ""


def _candidates(checkpoint: Checkpoint) -> Iterator[Path]:
    """Where the data set may be that training was given: a relative folder was relative to where training ran."""
    path = checkpoint.folder / TRAINING
    if not path.exists():
        return
    dataset = read_json(path).get("dataset") or {}
    if dataset.get("root"):
        root = Path(dataset["root"])
        yield root
        if not root.is_absolute():
            yield from (folder / root for folder in checkpoint.folder.parents)
    elif dataset.get("repo_id"):
        from lerobot.utils.constants import HF_LEROBOT_HOME

        yield HF_LEROBOT_HOME / dataset["repo_id"]


def _mismatch(checkpoint: Checkpoint, root: Path) -> str:
    """Why a data set is not the one whose statistics the checkpoint's processors keep; empty if it is."""
    from safetensors.numpy import load_file

    path = root / STATISTICS
    if not path.is_file():
        return f"it has no {STATISTICS}"
    statistics = read_json(path)
    compared = 0
    for file in checkpoint.processors:
        if file.suffix != ".safetensors":
            continue
        for name, value in load_file(file).items():
            feature, _, kind = name.rpartition(".")
            if feature not in statistics or kind not in statistics[feature]:
                return f"it has no {name}"
            ours = np.ravel(np.asarray(statistics[feature][kind], np.float64))
            theirs = np.ravel(value).astype(np.float64)
            if ours.shape != theirs.shape or not np.allclose(ours, theirs, rtol=_CLOSE, atol=_CLOSE):
                return f"its {name} differs"
            compared += kind in ("mean", "std")
    return "" if compared >= 2 else "the checkpoint's processors keep no statistics to compare"


def _check_seeds(known: list[TrainingSeeds], task: str, seeds: Sequence[int]) -> None:
    """Raises ValueError if the policy learned another task, or from some of the seeds."""
    tasks = {base_name(entry.task) for entry in known if entry.task is not None}
    if tasks and base_name(task) not in tasks:
        raise ValueError(f"the policy was trained on the task {', '.join(sorted(tasks))}, not on {base_name(task)}")
    used = {
        seed
        for entry in known
        if entry.task is None or base_name(entry.task) == base_name(task)
        for seed in entry.seeds
    }
    if shared := set(seeds) & used:
        raise ValueError(
            f"{len(shared)} of {len(seeds)} seeds ({min(shared)} to {max(shared)}) were in the training data, which are seeds "
            f"{min(used)} to {max(used)}; choose a seed above {max(used)}"
        )
