"""Whether seeds were in the data that a policy was trained on."""

from __future__ import annotations

import json
from pathlib import Path

from hdril.demonstrations.provenance import Provenance, read_provenance
from hdril.tasks import base_name


def training_provenance(policy: str) -> Provenance | None:
    """How the data were made that a checkpoint was trained on; None if that cannot be told from here."""
    path = Path(policy) / "train_config.json"
    if not path.exists():
        return None
    dataset = json.loads(path.read_text()).get("dataset") or {}
    root = dataset.get("root")
    if root is None and dataset.get("repo_id"):
        from lerobot.utils.constants import HF_LEROBOT_HOME

        root = HF_LEROBOT_HOME / dataset["repo_id"]
    return read_provenance(Path(root)) if root else None


def check_held_out(provenance: Provenance | None, task: str, seeds: list[int]) -> bool:
    """Whether the seeds are known to be held out: False if there is no telling.

    Raises:
        ValueError: the policy was trained on some of the seeds, or on another task.
    """
    if provenance is None:
        return False
    if base_name(provenance.recipe.task) != base_name(task):
        raise ValueError(f"the policy was trained on the task {provenance.recipe.task!r}, not on {task!r}")
    if shared := set(seeds) & set(provenance.seeds):
        raise ValueError(
            f"{len(shared)} of {len(seeds)} seeds ({min(shared)} to {max(shared)}) were in the training data, which are seeds "
            f"{min(provenance.seeds)} to {max(provenance.seeds)}; choose a seed above {max(provenance.seeds)}"
        )
    return True
