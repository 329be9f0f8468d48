"""Episodes of an unfinished recording on disk."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import Recipe
from hdril.files import MAX_SEED


class Shelf:
    """Episodes of an unfinished recording, a file each, so that an interrupted one can go on where it was."""

    def __init__(self, folder: Path, recipe: Recipe, first_seed: int) -> None:
        self.folder = folder
        plan = recipe.as_dict() | {"first_seed": first_seed}
        plan_file = folder / "plan.json"
        if plan_file.exists() and json.loads(plan_file.read_text()) != plan:
            raise ValueError(f"{folder} holds episodes of another recipe; delete it or choose another root")
        folder.mkdir(parents=True, exist_ok=True)
        plan_file.write_text(json.dumps(plan, indent=2))

    def put(self, episode: Episode) -> None:
        part = self.folder / "part.tmp"
        with part.open("wb") as file:
            np.savez(file, allow_pickle=False, **{name: np.asarray(value) for name, value in vars(episode).items()})
        part.replace(self.folder / f"{episode.seed}.npz")

    def take(self, first_seed: int) -> Iterator[Episode]:
        """Episodes from ``first_seed`` on, up to the first that is not there."""
        for seed in range(first_seed, MAX_SEED):
            path = self.folder / f"{seed}.npz"
            if not path.exists():
                return
            with np.load(path) as data:
                values = dict(data)
            yield Episode(**values | {"seed": seed, "success": bool(values["success"]), "unmet": str(values["unmet"])})
