"""Episodes of an unfinished recording on disk."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from dataclasses import fields
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from hdril import __version__
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import Recipe
from hdril.errors import UserError
from hdril.files import write_atomically

_PLAN = "plan.json"


class Shards:
    """Episodes of an unfinished recording, a file each, so that an interrupted one can go on where it was.

    Raises:
        ValueError: the folder holds episodes of another recipe, version of hdril or first seed.
    """

    def __init__(self, folder: Path, recipe: Recipe, first_seed: int) -> None:
        self._folder, self._first_seed = folder, first_seed
        plan = json.dumps(recipe.as_dict(__version__) | {"first_seed": first_seed}, indent=2)
        plan_file = folder / _PLAN
        if plan_file.exists() and plan_file.read_text() != plan:
            raise ValueError(f"{folder} holds episodes of another recipe; delete it or choose another root")
        write_atomically(plan_file, lambda file: file.write(plan.encode()))

    def path(self, seed: int) -> Path:
        """Where the episode of a seed is kept."""
        return self._folder / f"{seed}.npz"

    def put(self, episode: Episode) -> None:
        """Keep an episode, whether it succeeded or not.

        Raises:
            UserError: the folder was removed: another process finished the recording, or gave it up.
        """
        if not (self._folder / _PLAN).exists():
            raise UserError(
                f"{self._folder} was removed by another process, which finished the recording or gave it up"
            )
        arrays = {name: np.asarray(value) for name, value in vars(episode).items()}
        write_atomically(self.path(episode.seed), lambda file: np.savez(file, allow_pickle=False, **arrays))

    def get(self, seed: int) -> Episode:
        """The episode of a seed.

        Raises:
            FileNotFoundError: it is not there.
            ValueError, KeyError, EOFError, zipfile.BadZipFile: it cannot be read.
        """
        return _load(self.path(seed), seed)

    def take(self, first_seed: int | None = None) -> Iterator[Episode]:
        """Episodes from a seed on, the first of all unless given, up to the first that is not there or cannot be read.

        That one is to be made again.
        """
        for seed in count(self._first_seed if first_seed is None else first_seed):
            if not self.path(seed).exists():
                return
            try:
                yield _load(self.path(seed), seed)
            except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
                print(f"{self.path(seed)} cannot be read ({error}); the episode is made again", flush=True)
                return


def _load(path: Path, seed: int) -> Episode:
    # np.load leaves a file that it opened itself open when it fails.
    with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
        values: dict[str, Any] = {field.name: data[field.name] for field in fields(Episode)}
    if values["seed"] != seed:
        raise ValueError(f"it holds seed {values['seed']}")
    if len({len(value) for value in values.values() if value.ndim}) != 1:
        raise ValueError("its arrays differ in length")
    texts: dict[str, Any] = {name: str(values[name]) for name in ("unmet", "scenario")}
    return Episode(**values | texts | {"seed": seed, "success": bool(values["success"])})
