"""Write demonstrations as a LeRobot dataset."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hdril.demonstrations.content import content, dataset_digest, episode_digest
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import Provenance, write_provenance
from hdril.demonstrations.schema import (
    DIGEST,
    PROPORTIONS_PATH,
    SCENARIO,
    SEED,
    SUBTASK,
    SUBTASKS_PATH,
    features,
)
from hdril.env import BimanualEnv
from hdril.tasks import get_task

if TYPE_CHECKING:
    import pyarrow as arrow
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from pyarrow import parquet


@dataclass(frozen=True)
class Layout:
    """What a dataset is of, beside its episodes."""

    description: str
    """The task, in words."""
    labels: tuple[str, ...]
    """Names of the primitives."""
    features: Mapping[str, dict[str, Any]]
    """As LeRobot declares them."""
    robot: str
    fps: int


def write_dataset(
    root: Path, provenance: Provenance, episodes: Iterable[Episode], file_mb: int | None = None
) -> Provenance:
    """Write the episodes, which are those of ``provenance`` and in its order, as a new dataset at ``root``.

    Returns the provenance with the digest of the episodes, as it was written. Else as :func:`write_episodes`.
    """
    recipe = provenance.recipe
    task, fps = get_task(recipe.task), BimanualEnv.metadata["render_fps"]
    layout = Layout(task.description, task.labels, features(recipe), recipe.robot, fps)
    digests = write_episodes(root, layout, episodes, file_mb)
    provenance = replace(provenance, digest=dataset_digest(digests))
    write_provenance(root, provenance)
    return provenance


def write_episodes(root: Path, layout: Layout, episodes: Iterable[Episode], file_mb: int | None = None) -> list[str]:
    """Write the episodes as a new dataset at ``root``, which does not say how to make them again; returns their digests.

    One episode is in memory at a time. A file of frames is closed when it has ``file_mb`` MB or more; LeRobot's own number
    unless given.

    The tables are written here and not through ``LeRobotDataset.add_frame``, which spends most of its time on looking
    for images in each frame: this is six times as fast and gives the same files.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    metadata = LeRobotDatasetMetadata.create(
        # A dataset on disk does not hold its repository's name, but LeRobot asks for one.
        "local/dataset", layout.fps, dict(layout.features), layout.robot, root, use_videos=False,
        metadata_buffer_size=1000, data_files_size_in_mb=file_mb,
    )  # fmt: skip
    metadata.save_episode_tasks([layout.description])
    try:
        digests, frames = _write_frames(metadata, layout, episodes)
        metadata.finalize()
    except BaseException:
        # Otherwise it writes what it holds when it is collected, and makes the folder again, which may be removed by then.
        with suppress(Exception):
            metadata.finalize()
        raise
    _sort_statistics(root)
    _write_names(root, layout, frames)
    return digests


def _write_frames(
    metadata: LeRobotDatasetMetadata, layout: Layout, episodes: Iterable[Episode]
) -> tuple[list[str], NDArray[np.int64]]:
    """Write frames and the table of episodes; returns the digests of the episodes, and how many frames have each label."""
    import pyarrow as arrow
    from lerobot.datasets.compute_stats import compute_episode_stats
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    columns = get_hf_features_from_features(metadata.features)
    start, digests, played = 0, [], np.zeros(len(layout.labels), np.int64)
    with closing(_DataFiles(metadata, columns.arrow_schema)) as files:
        for index, episode in enumerate(episodes):
            frames = content(episode)
            digests.append(episode_digest(frames, episode.seed, episode.scenario))
            frames |= _places(len(episode), index, start, metadata.fps)
            # Not Dataset.from_dict, which spends 50 ms on a fingerprint of each episode.
            table = arrow.Table.from_pydict({key: list(frames[key]) for key in columns}, schema=columns.arrow_schema)
            place = files.write(table)
            values: dict[str, list[str] | np.ndarray] = {key: frames[key] for key in metadata.features}
            stats = compute_episode_stats(values, metadata.features)
            told = {SEED: episode.seed, SCENARIO: episode.scenario, DIGEST: digests[-1]}
            row = place | told | _segments(episode, layout.labels)
            metadata.save_episode(index, len(episode), [layout.description], stats, row)
            start += len(episode)
            played += np.bincount(episode.label, minlength=len(layout.labels))
    return digests, played


class _DataFiles:
    """The files of frames, one after the other."""

    def __init__(self, metadata: LeRobotDatasetMetadata, schema: arrow.Schema) -> None:
        self._metadata, self._schema = metadata, schema
        self._chunk, self._file = 0, 0
        self._sink: arrow.OSFile | None = None
        self._writer: parquet.ParquetWriter | None = None

    def write(self, table: arrow.Table) -> dict[str, int]:
        """Write an episode's frames; returns where it is, in the columns of the table of episodes."""
        import pyarrow as arrow
        import pyarrow.parquet as parquet
        from lerobot.datasets.utils import update_chunk_file_indices

        meta = self._metadata
        if self._sink is not None and self._sink.tell() >= meta.data_files_size_in_mb * 2**20:
            self.close()
            self._chunk, self._file = update_chunk_file_indices(self._chunk, self._file, meta.chunks_size)
        if self._writer is None:
            path = meta.root / meta.data_path.format(chunk_index=self._chunk, file_index=self._file)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._sink = arrow.OSFile(str(path), "wb")
            self._writer = parquet.ParquetWriter(self._sink, self._schema)
        self._writer.write_table(table)
        return {"data/chunk_index": self._chunk, "data/file_index": self._file}

    def close(self) -> None:
        """Finish the file that is open."""
        if self._writer is not None and self._sink is not None:
            self._writer.close()
            self._sink.close()
        self._writer = self._sink = None


def _sort_statistics(root: Path) -> None:
    """LeRobot writes the columns in an order that is another one in each process; the same dataset is to be the same bytes."""
    from lerobot.datasets.utils import STATS_PATH

    path = root / STATS_PATH
    path.write_text(json.dumps(json.loads(path.read_text()), indent=4, sort_keys=True))


def _write_names(root: Path, layout: Layout, frames: NDArray[np.int64]) -> None:
    """The names of task and primitives, and the primitives' shares of an episode, of which ``frames`` are played."""
    import pandas as pd

    # Rerun's loader looks for the column that pandas makes of an index without a name, LeRobot reads it under any name.
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([layout.description]))
    tasks.to_parquet(root / "meta/tasks.parquet")
    write_primitives(root, layout.labels)
    shares = dict(zip(layout.labels, (frames / frames.sum()).tolist(), strict=True))
    (root / PROPORTIONS_PATH).write_text(json.dumps(shares, indent=2))


def write_primitives(root: Path, names: Sequence[str]) -> None:
    """Write the names of the primitives, by label."""
    import pandas as pd

    table = pd.DataFrame({SUBTASK: range(len(names))}, index=pd.Index(names, name="subtask"))
    table.to_parquet(root / SUBTASKS_PATH)


def _places(count: int, index: int, start: int, fps: int) -> dict[str, np.ndarray]:
    """LeRobot's columns of the ``index``-th episode of ``count`` frames, the first of which is the dataset's ``start``-th."""
    return {
        "timestamp": (np.arange(count) / fps).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, index),
        "index": np.arange(start, start + count),
        "task_index": np.zeros(count, np.int64),
    }


def _segments(episode: Episode, labels: tuple[str, ...]) -> dict[str, Any]:
    """The primitives from each start to the next, in the columns that LeRobot's SARM reads (ends included)."""
    starts = np.flatnonzero(episode.start)
    ends = np.append(starts[1:], len(episode)) - 1
    return {
        "dense_subtask_names": [labels[label] for label in episode.label[starts]],
        "dense_subtask_start_frames": starts.tolist(),
        "dense_subtask_end_frames": ends.tolist(),
    }
