"""Record demonstrations as a LeRobot dataset."""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future
from contextlib import closing
from functools import cache
from itertools import islice
from pathlib import Path

from hdril.actor import Actor
from hdril.demonstrations.episode import Episode, demonstrate
from hdril.demonstrations.labels import add_words
from hdril.demonstrations.provenance import Provenance, Recipe
from hdril.demonstrations.shards import Shards, check_unfinished, remove_lock
from hdril.demonstrations.write import write_dataset
from hdril.env import BimanualEnv
from hdril.errors import UserError
from hdril.execution import share
from hdril.files import MAX_SEED, exclusively, naming
from hdril.workers import worker_pool

PATIENCE = 20
"""How many more demonstrations may fail than succeed before a recording is given up."""


class ExpertError(UserError):
    """The expert fails more often than it succeeds: the task, its parameters or the noise cannot be right."""


@cache
def _stage(recipe: Recipe) -> tuple[BimanualEnv, Actor]:
    """What a worker process needs, made for its first episode."""
    return recipe.make_env(), recipe.make_expert()


def _work(recipe: Recipe, seed: int) -> Episode:
    return demonstrate(*_stage(recipe), seed)


def episodes(recipe: Recipe, first_seed: int, workers: int = 1) -> Generator[Episode]:
    """Demonstrations of seeds ``first_seed``, + 1, + 2, … up to :data:`~hdril.files.MAX_SEED`, as :func:`play` gives them."""
    return play(recipe, range(first_seed, MAX_SEED + 1), workers)


def play(recipe: Recipe, seeds: Iterable[int], workers: int = 1) -> Generator[Episode]:
    """Demonstrations of these seeds, in this order whatever the number of workers.

    Close the iterator when you have enough.

    Raises:
        UserError: a worker process died.
    """
    if workers > 1:
        yield from _in_parallel(recipe, iter(seeds), workers)
        return
    env, expert = recipe.make_env(), recipe.make_expert()
    with closing(env):
        for seed in seeds:
            yield demonstrate(env, expert, seed)


def _in_parallel(recipe: Recipe, seeds: Iterator[int], workers: int) -> Generator[Episode]:
    pending: deque[Future[Episode]] = deque()
    with worker_pool(workers) as pool:

        def submit(count: int) -> None:
            pending.extend(pool.submit(_work, recipe, seed) for seed in islice(seeds, count))

        submit(2 * workers)
        while pending:
            yield pending.popleft().result()
            submit(1)


def record(
    recipe: Recipe,
    num_episodes: int,
    first_seed: int,
    root: Path,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    words: bool = False,
) -> Provenance:
    """Record ``num_episodes`` successful demonstrations as a LeRobot dataset at ``root``.

    Seeds are tried in order from ``first_seed``; failures are dropped and reported. Until the dataset is whole it lives
    in ``<root>.partial``; after an interruption the same call goes on from there. ``progress`` is called with the numbers
    of kept and dropped episodes. With ``words``, the primitives are in ``language_persistent``, too.

    Raises:
        FileExistsError: there is something at ``root``, or something that is no recording at ``<root>.partial``.
        ValueError: a number out of range, a partial recording of another recipe, or too few seeds up to the largest; an
            episode was damaged after it was looked at.
        ExpertError: the expert fails more often than it succeeds.
        BusyError: another process records to ``root``.
        OSError: something cannot be written; names it. Episodes that were played are kept.
    """
    check_numbers(num_episodes, first_seed, workers)
    refuse_existing(root)
    partial = partial_folder(root)
    check_unfinished(partial, recipe, first_seed)  # before there is a lock in it
    with exclusively(partial, f"recording to {root}"):
        try:
            refuse_existing(root)  # the process that held the lock until now may have finished it
            shards = Shards(partial, recipe, first_seed)
        except BaseException:
            remove_lock(partial)  # what else came there meanwhile is not of this recording
            raise
        try:
            selection = Selection(num_episodes, progress)
            _fill(selection, shards, lambda seed: episodes(recipe, seed, workers), first_seed)
            provenance = Provenance(recipe, tuple(selection.kept), selection.dropped)
            provenance = _publish(provenance, shards, root, words)
        except BaseException as error:
            if isinstance(error, ExpertError) or shards.empty:
                shards.remove()  # there is nothing to go on from
            raise
    return provenance


def record_shard(
    recipe: Recipe,
    num_episodes: int,
    first_seed: int,
    root: Path,
    shard: int,
    shards: int,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Play the ``shard``-th of ``shards`` shares of ``num_episodes`` seeds from ``first_seed`` on, and keep the episodes.

    They are kept where :func:`record` with the same arguments finds them. It plays what is missing, and makes the dataset.
    Any number of shards may be played at once, on machines that share the disk. A seed that was played is not played again.
    ``progress`` is called with the numbers of successful and failed episodes.

    Raises:
        FileExistsError, ValueError: as :func:`record`; there is no such shard.
        ExpertError: the expert fails more often than it succeeds.
    """
    check_numbers(num_episodes, first_seed, workers)
    seeds = share(range(first_seed, first_seed + num_episodes), shard, shards)
    refuse_existing(root)
    kept = Shards(partial_folder(root), recipe, first_seed)
    selection = Selection(num_episodes, progress)
    with closing(play(recipe, [seed for seed in seeds if not kept.path(seed).exists()], workers)) as fresh:
        for episode in fresh:
            kept.put(episode)
            selection.add(episode)


def check_numbers(num_episodes: int, first_seed: int, workers: int) -> None:
    """Raises ValueError unless so many episodes can be recorded from a seed on."""
    if num_episodes < 1:
        raise ValueError(f"num_episodes must be at least 1, got {num_episodes}")
    if not 0 <= first_seed <= MAX_SEED - num_episodes:
        raise ValueError(f"seed must be from 0 to {MAX_SEED - num_episodes}, got {first_seed}")
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")


def partial_folder(root: Path) -> Path:
    """Where the dataset of ``root`` lives until it is whole."""
    return root.with_name(root.name + ".partial")


def refuse_existing(root: Path) -> None:
    """Raises FileExistsError if there is something at ``root``."""
    if root.exists():
        raise FileExistsError(f"{root} exists; choose another root or delete it")


class Selection:
    """Keeps the seeds of successful episodes until there are ``wanted``, and drops the others.

    The episodes are on disk: of a million, memory holds none.
    """

    def __init__(self, wanted: int, progress: Callable[[int, int], None] | None) -> None:
        self.kept: list[int] = []
        self.dropped: dict[int, str] = {}
        self._wanted, self._progress = wanted, progress

    @property
    def complete(self) -> bool:
        return len(self.kept) == self._wanted

    def add(self, episode: Episode) -> None:
        if episode.success:
            self.kept.append(episode.seed)
        else:
            self.dropped[episode.seed] = episode.unmet
        if len(self.dropped) > PATIENCE + len(self.kept):
            tried = len(self.dropped) + len(self.kept)
            raise ExpertError(f"the expert failed on {len(self.dropped)} of {tried} seeds; last: {episode.unmet}")
        if self._progress:
            self._progress(len(self.kept), len(self.dropped))


def _fill(selection: Selection, shards: Shards, stream: Callable[[int], Generator[Episode]], first_seed: int) -> None:
    """Add episodes in the order of seeds: those that are there, and new ones where one is missing."""
    seed, more = first_seed, True
    while more:
        for episode in shards.take(seed):
            selection.add(episode)
            if selection.complete:
                return
            seed = episode.seed + 1
        more = False
        with closing(stream(seed)) as fresh:
            for episode in fresh:
                shards.put(episode)
                selection.add(episode)
                if selection.complete:
                    return
                seed = episode.seed + 1
                if shards.path(seed).exists():  # of another shard
                    more = True
                    break
    raise ValueError(f"only {len(selection.kept)} demonstrations succeeded up to the largest seed; choose a lower seed")


def _publish(provenance: Provenance, shards: Shards, root: Path, words: bool) -> Provenance:
    """Write the dataset beside its place and move it there when it is whole; returns its provenance with its digest."""
    shutil.rmtree(shards.staged, ignore_errors=True)
    with naming(shards.staged):
        provenance = write_dataset(shards.staged, provenance, map(shards.get, provenance.seeds))
        if words:
            add_words(shards.staged)
    root.parent.mkdir(parents=True, exist_ok=True)
    shards.staged.replace(root)
    shards.remove()
    return provenance
