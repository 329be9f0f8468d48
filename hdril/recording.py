"""Demonstrations to a LeRobot dataset (v3.0). This file alone knows the dataset's schema."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril import __version__
from hdril.control import ACTION_NAMES
from hdril.demonstrator import Demonstrator
from hdril.env import BimanualEnv
from hdril.geometry import POSE_AXES
from hdril.primitives import Noise
from hdril.tasks import get_task
from hdril.world import Physics

RECIPE_PATH = "meta/hdril.json"
SUBTASKS_PATH = "meta/subtasks.parquet"
MAX_SEED = 2**31 - 1


@dataclass(frozen=True)
class Recipe:
    """All that makes a demonstration, beside its seed: with both, any episode can be made again, bit for bit.

    ``physics`` is the task's own unless given.

    Raises:
        ValueError: unknown task or robot.
    """

    task: str
    noise: Noise = field(default_factory=Noise)
    physics: Physics | None = None
    robot: str = "baxter"

    def __post_init__(self) -> None:
        task = get_task(self.task)
        if self.physics is None:
            object.__setattr__(self, "physics", task.physics)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self) | {"hdril_version": __version__}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Recipe:
        return Recipe(values["task"], Noise(**values["noise"]), Physics(**values["physics"]), values["robot"])

    def make_env(self) -> BimanualEnv:
        return BimanualEnv(self.task, robot=self.robot, physics=self.physics)


@dataclass(frozen=True)
class Episode:
    """One demonstration of T frames, float32, and how it ended (``unmet``: conditions of success that do not hold)."""

    seed: int
    state: NDArray[np.float32]  # (T, 16)
    environment_state: NDArray[np.float32]  # (T, 7 per object)
    action: NDArray[np.float32]  # (T, 16)
    label: NDArray[np.int64]  # (T,)
    reward: NDArray[np.float32]  # (T,)
    success: bool
    unmet: str

    def __len__(self) -> int:
        return len(self.action)


def demonstrate(env: BimanualEnv, expert: Demonstrator, seed: int) -> Episode:
    """Run the expert once, on the scene of ``seed``."""
    observation, _ = env.reset(seed=seed)
    expert.reset(seed)
    rows: list[tuple[Any, ...]] = []
    done, info = False, {}
    while not done:
        step = expert.act(observation)
        action = step.action.astype(np.float32)
        before = observation
        # What is recorded is what was sent: float32.
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append((before["agent_pos"], before["environment_state"], action, step.label, reward))
        done = terminated or truncated
    state, environment_state, actions, labels, rewards = (list(column) for column in zip(*rows, strict=True))
    return Episode(
        seed,
        np.stack(state),
        np.stack(environment_state),
        np.stack(actions),
        np.array(labels, np.int64),
        np.array(rewards, np.float32),
        bool(info["is_success"]),
        str(info["unmet"]),
    )


# ---------------------------------------------------------------------- many episodes

_worker: tuple[BimanualEnv, Demonstrator] | None = None


def _start_worker(recipe: Recipe) -> None:
    global _worker
    env = recipe.make_env()
    _worker = env, Demonstrator(env.task_spec, recipe.noise)


def _work(seed: int) -> Episode:
    if _worker is None:
        raise RuntimeError("the worker was not started")
    return demonstrate(*_worker, seed)


def episodes(recipe: Recipe, first_seed: int, workers: int = 1) -> Generator[Episode]:
    """Demonstrations of seeds ``first_seed``, + 1, + 2, …, in this order whatever the number of workers, without end.

    Close the iterator when you have enough.
    """
    if workers == 1:
        env = recipe.make_env()
        expert = Demonstrator(env.task_spec, recipe.noise)
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


class _Shelf:
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
    shelf = _Shelf(partial, recipe, first_seed)
    kept: list[Episode] = []
    dropped: dict[int, str] = {}

    def sort(episode: Episode) -> None:
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
        sort(episode)
        seed = episode.seed + 1
    if len(kept) < num_episodes:
        with closing(episodes(recipe, seed, workers)) as stream:
            for episode in stream:
                shelf.put(episode)
                sort(episode)
                if len(kept) == num_episodes:
                    break
    staged = partial / "dataset"
    shutil.rmtree(staged, ignore_errors=True)
    write_dataset(staged, repo_id, recipe, kept, dropped)
    root.parent.mkdir(parents=True, exist_ok=True)
    staged.replace(root)
    shutil.rmtree(partial, ignore_errors=True)
    return Recording(root, tuple(episode.seed for episode in kept), dropped)


# ---------------------------------------------------------------------- the schema


def features(recipe: Recipe) -> dict[str, dict[str, Any]]:
    """Features of the dataset, as LeRobot declares them."""
    objects = [f"{name}.{axis}" for name in get_task(recipe.task).observed for axis in POSE_AXES]

    def vector(names: list[str]) -> dict[str, Any]:
        return {"dtype": "float32", "shape": (len(names),), "names": names}

    return {
        "observation.state": vector(list(ACTION_NAMES)),
        "observation.environment_state": vector(objects),
        "action": vector(list(ACTION_NAMES)),
        "subtask_index": {"dtype": "int64", "shape": (1,), "names": None},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    }


def write_dataset(root: Path, repo_id: str, recipe: Recipe, kept: list[Episode], dropped: dict[int, str]) -> None:
    """Write ``kept`` as a new dataset at ``root``.

    The tables are written here and not through ``LeRobotDataset.add_frame``, which spends most of its time on looking
    for images in each frame: this is six times as fast and gives the same files.
    """
    import pandas as pd
    import pyarrow as arrow
    import pyarrow.parquet as parquet
    from lerobot.datasets.compute_stats import compute_episode_stats
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    task = get_task(recipe.task)
    metadata = LeRobotDatasetMetadata.create(
        repo_id, BimanualEnv.metadata["render_fps"], features(recipe), recipe.robot, root, use_videos=False,
        metadata_buffer_size=1000,
    )  # fmt: skip
    metadata.save_episode_tasks([task.description])
    columns = get_hf_features_from_features(metadata.features)
    data_path = root / metadata.data_path.format(chunk_index=0, file_index=0)
    data_path.parent.mkdir(parents=True, exist_ok=True)
    writer, start = None, 0
    for index, episode in enumerate(kept):
        frames = _frames(episode, index, start, metadata.fps)
        # Not Dataset.from_dict, which spends 50 ms on a fingerprint of each episode.
        table = arrow.Table.from_pydict({key: list(frames[key]) for key in columns}, schema=columns.arrow_schema)
        writer = writer or parquet.ParquetWriter(data_path, table.schema)
        writer.write_table(table)
        stats = compute_episode_stats({key: np.asarray(frames[key]) for key in metadata.features}, metadata.features)
        metadata.save_episode(
            index,
            len(episode),
            [task.description],
            stats,
            {"data/chunk_index": 0, "data/file_index": 0, "seed": episode.seed} | _segments(episode, task.labels),
        )
        start += len(episode)
    if writer is not None:
        writer.close()
    metadata.finalize()
    # Rerun's loader looks for the column that pandas makes of an index without a name, LeRobot reads it under any name.
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([task.description]))
    tasks.to_parquet(root / "meta/tasks.parquet")
    subtasks = pd.DataFrame({"subtask_index": range(len(task.labels))}, index=pd.Index(task.labels, name="subtask"))
    subtasks.to_parquet(root / SUBTASKS_PATH)
    shares = {name: sum(p.frames for p in task.primitives if p.name == name) / task.horizon for name in task.labels}
    (root / "meta/temporal_proportions_dense.json").write_text(json.dumps(shares, indent=2))
    provenance = {
        "recipe": recipe.as_dict(),
        "seeds": [episode.seed for episode in kept],
        "dropped": {str(seed): why for seed, why in dropped.items()},
    }
    (root / RECIPE_PATH).write_text(json.dumps(provenance, indent=2))


def _frames(episode: Episode, index: int, start: int, fps: int) -> dict[str, Any]:
    count = len(episode)
    last = np.arange(count) == count - 1
    return {
        "observation.state": episode.state,
        "observation.environment_state": episode.environment_state,
        "action": episode.action,
        "subtask_index": episode.label,
        "next.reward": episode.reward,
        "next.success": last & episode.success,
        "next.done": last,
        "timestamp": (np.arange(count) / fps).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, index),
        "index": np.arange(start, start + count),
        "task_index": np.zeros(count, np.int64),
    }


def _segments(episode: Episode, labels: tuple[str, ...]) -> dict[str, Any]:
    """The primitives as runs of equal labels, in the columns that LeRobot's SARM reads (ends included)."""
    starts = np.flatnonzero(np.diff(episode.label, prepend=-1))
    ends = np.append(starts[1:], len(episode)) - 1
    return {
        "dense_subtask_names": [labels[label] for label in episode.label[starts]],
        "dense_subtask_start_frames": starts.tolist(),
        "dense_subtask_end_frames": ends.tolist(),
    }


# ---------------------------------------------------------------------- reading back


@dataclass(frozen=True)
class Provenance:
    """How a dataset was made: its recipe and the seeds of its episodes, in order."""

    recipe: Recipe
    seeds: tuple[int, ...]


def read_provenance(root: Path) -> Provenance | None:
    """The recipe and seeds of a dataset; None for a dataset that hdril did not record."""
    path = root / RECIPE_PATH
    with suppress(FileNotFoundError):
        values = json.loads(path.read_text())
        return Provenance(Recipe.from_dict(values["recipe"]), tuple(values["seeds"]))
    return None
