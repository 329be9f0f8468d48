"""Episodes of an unfinished recording on disk."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from hdril import __version__
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import Recipe
from hdril.errors import UserError
from hdril.files import LOCK, is_scrap, read_arrays, write_atomically

_PLAN = "plan.json"
_STAGED = "dataset"


class Shards:
    """Episodes of an unfinished recording, a file each, so that an interrupted one can go on where it was.

    Raises:
        ValueError: the folder holds episodes of another recipe, version of hdril or first seed, or its plan is damaged.
        FileExistsError: the folder holds something that is no recording.
    """

    def __init__(self, folder: Path, recipe: Recipe, first_seed: int) -> None:
        self._folder, self._first_seed = folder, first_seed
        check_unfinished(folder, recipe, first_seed)
        write_atomically(folder / _PLAN, lambda file: file.write(_plan(recipe, first_seed)))

    @property
    def staged(self) -> Path:
        """Where the dataset is written before it is moved to its place."""
        return self._folder / _STAGED

    @property
    def empty(self) -> bool:
        """Whether there is no episode yet."""
        return not any(map(_is_episode, _there(self._folder)))

    def remove(self) -> None:
        """Remove what the recording wrote, and the folder. Files of others stay, and are told."""
        # First the plan: a shard that is late sees by it that the recording is over.
        (self._folder / _PLAN).unlink(missing_ok=True)
        shutil.rmtree(self.staged, ignore_errors=True)
        for path in _there(self._folder):
            if _is_episode(path) or is_scrap(path.name):
                with suppress(OSError):  # what cannot be removed is told
                    path.unlink()
        remove_lock(self._folder)
        if foreign := sorted(path.name for path in _there(self._folder) if not path.name.startswith(".")):
            print(f"{self._folder} stays: {foreign[0]} is there, which the recording did not write", flush=True)

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
            ValueError: it is damaged.
        """
        try:
            return _load(self.path(seed), seed)
        except ValueError as error:  # since it was taken
            raise ValueError(f"{error}; the same command makes the episode again") from error

    def take(self, first_seed: int | None = None) -> Iterator[Episode]:
        """Episodes from a seed on, the first of all unless given, up to the first that is not there or cannot be read.

        That one is to be made again.
        """
        for seed in count(self._first_seed if first_seed is None else first_seed):
            if not self.path(seed).exists():
                return
            try:
                yield _load(self.path(seed), seed)
            except ValueError as error:
                print(f"{error}; the episode is made again", flush=True)
                return


def check_unfinished(folder: Path, recipe: Recipe, first_seed: int) -> None:
    """Check that a recording may begin or go on in a folder; nothing is written.

    Raises:
        ValueError, FileExistsError: as for :class:`Shards`.
    """
    path, remedy = folder / _PLAN, "delete it or choose another root"
    # Another process may write its plan after the first look.
    if not path.exists() and _holds_more_than_a_lock(folder) and not path.exists():
        raise FileExistsError(f"{folder} exists and is no unfinished recording; {remedy}")
    if not path.exists() or (there := path.read_bytes()) == _plan(recipe, first_seed):
        return
    try:
        json.loads(there)
    except ValueError:
        raise ValueError(
            f"{path} is damaged: what the episodes beside it are of is not known; delete {folder} or choose another root"
        ) from None
    raise ValueError(f"{folder} holds episodes of another recipe; {remedy}")


def _plan(recipe: Recipe, first_seed: int) -> bytes:
    """What an unfinished recording is of."""
    return json.dumps(recipe.as_dict(__version__) | {"first_seed": first_seed}, indent=2).encode()


def remove_lock(folder: Path) -> None:
    """Remove the lock that this process holds, and the folder if nothing else is in it."""
    (folder / LOCK).unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def _there(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.exists() else []


def _holds_more_than_a_lock(folder: Path) -> bool:
    return any(path.name != LOCK and not is_scrap(path.name) for path in _there(folder))


def _is_episode(path: Path) -> bool:
    return path.suffix == ".npz" and path.stem.isdecimal()


def _load(path: Path, seed: int) -> Episode:
    values = read_arrays(path)
    if missing := [field.name for field in fields(Episode) if field.name not in values]:
        raise ValueError(f"{path} is damaged: it lacks {', '.join(missing)}")
    if values["seed"] != seed:
        raise ValueError(f"{path} is damaged: it holds seed {values['seed']}")
    if len({len(value) for value in values.values() if value.ndim}) != 1:
        raise ValueError(f"{path} is damaged: its arrays differ in length")
    texts: dict[str, Any] = {name: str(values[name]) for name in ("unmet", "scenario")}
    known = {field.name: values[field.name] for field in fields(Episode)}
    return Episode(**known | texts | {"seed": seed, "success": bool(values["success"])})
