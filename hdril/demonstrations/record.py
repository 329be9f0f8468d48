"""Record demonstrations as a LeRobot dataset."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Generator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from hdril.demonstrations.episode import Episode, demonstrate
from hdril.demonstrations.provenance import Recipe
from hdril.demonstrations.schema import write_dataset
from hdril.demonstrations.shards import Shelf
from hdril.env import BimanualEnv
from hdril.files import MAX_SEED
from hdril.tasks.expert import ScriptedExpert

_worker: tuple[BimanualEnv, ScriptedExpert] | None = None


def _start_worker(recipe: Recipe) -> None:
    global _worker
    _worker = recipe.make_env(), recipe.make_expert()


def _work(seed: int) -> Episode:
    if _worker is None:
        raise RuntimeError("the worker was not started")
    return demonstrate(*_worker, seed)


def episodes(recipe: Recipe, first_seed: int, workers: int = 1) -> Generator[Episode]:
    """Demonstrations of seeds ``first_seed``, + 1, + 2, …, in this order whatever the number of workers, without end.

    Close the iterator when you have enough.
    """
    if workers == 1:
        env, expert = recipe.make_env(), recipe.make_expert()
        with closing(env):
            for seed in range(first_seed, MAX_SEED):
                yield demonstrate(env, expert, seed)
        return
    pool = ProcessPoolExecutor(workers, get_context("forkserver"), initializer=_start_worker, initargs=(recipe,))
    pending: list[Future[Episode]] = []
    seeds = iter(range(first_seed, MAX_SEED))
    try:
        pending = [pool.submit(_work, next(seeds)) for _ in range(2 * workers)]
        while True:
            yield pending.pop(0).result()
            pending.append(pool.submit(_work, next(seeds)))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True)
class Recording:
    """What was recorded: where, the seeds of the episodes in order, and why which seeds were dropped."""

    root: Path
    seeds: tuple[int, ...]
    dropped: dict[int, str]


def record(
    recipe: Recipe,
    num_episodes: int,
    first_seed: int,
    repo_id: str,
    root: Path,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Recording:
    """Record ``num_episodes`` successful demonstrations as a LeRobot dataset at ``root``.

    Seeds are tried in order from ``first_seed``; failures are dropped and reported. Until the dataset is whole it lives
    in ``<root>.partial``; after an interruption the same call goes on from there. ``progress`` is called with the numbers
    of kept and dropped episodes.

    Raises:
        FileExistsError: there is something at ``root``.
        ValueError: a number out of range, or a partial recording of another recipe.
        RuntimeError: the expert fails more often than it succeeds: the scene cannot be right.
    """
    if num_episodes < 1:
        raise ValueError(f"num_episodes must be at least 1, got {num_episodes}")
    if not 0 <= first_seed <= MAX_SEED - num_episodes:
        raise ValueError(f"seed must be from 0 to {MAX_SEED - num_episodes}, got {first_seed}")
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if root.exists():
        raise FileExistsError(f"{root} exists; choose another root or delete it")
    partial = root.with_name(root.name + ".partial")
    shelf = Shelf(partial, recipe, first_seed)
    kept: list[Episode] = []
    dropped: dict[int, str] = {}

    def keep_or_drop(episode: Episode) -> None:
        if episode.success:
            kept.append(episode)
        else:
            dropped[episode.seed] = episode.unmet
            if len(dropped) > 20 + len(kept):
                raise RuntimeError(
                    f"the expert failed on {len(dropped)} of {len(dropped) + len(kept)} seeds; last: {episode.unmet}"
                )
        if progress:
            progress(len(kept), len(dropped))

    seed = first_seed
    for episode in shelf.take(first_seed):
        if len(kept) == num_episodes:
            break
        keep_or_drop(episode)
        seed = episode.seed + 1
    if len(kept) < num_episodes:
        with closing(episodes(recipe, seed, workers)) as stream:
            for episode in stream:
                shelf.put(episode)
                keep_or_drop(episode)
                if len(kept) == num_episodes:
                    break
    staged = partial / "dataset"
    shutil.rmtree(staged, ignore_errors=True)
    write_dataset(staged, repo_id, recipe, kept, dropped)
    root.parent.mkdir(parents=True, exist_ok=True)
    staged.replace(root)
    shutil.rmtree(partial, ignore_errors=True)
    return Recording(root, tuple(episode.seed for episode in kept), dropped)
