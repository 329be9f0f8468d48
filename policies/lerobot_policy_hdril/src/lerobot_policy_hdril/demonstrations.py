"""The dataset's low-dimensional columns, held in memory, and windows of them by frame index.

LeRobot's loader can cut windows itself, through delta timestamps, but at batch 70 it gives 70 to 540 of them a second;
single frames come at thousands a second, and a gather from memory gives 90,000. So the loader yields single frames, of
which the policy uses ``index`` alone.
"""

from __future__ import annotations

import gc
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pyarrow.parquet as parquet
import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

SUBTASKS_PATH = "meta/subtasks.parquet"


@dataclass(frozen=True)
class Window:
    """The rest of a primitive from a frame on, for B samples, padded to M frames.

    ``state`` (B, S) is what is seen at the start; ``elapsed`` (B,) how many frames of the primitive are over by then;
    ``target`` (B, M, A + S) the actions and the states that they lead to; ``mask`` (B, M) is True on real frames.
    """

    state: Tensor
    primitive: Tensor  # (B,)
    elapsed: Tensor
    target: Tensor
    mask: Tensor


@dataclass(frozen=True)
class History:
    """Whole episodes for B samples, padded to T frames: states (B, T, S), labels (B, T), mask (B, T)."""

    state: Tensor
    primitive: Tensor
    mask: Tensor


def read_primitives(root: Path) -> list[str]:
    """Names of the primitives in the order of their labels.

    Raises:
        ValueError: the dataset does not say what its labels mean.
    """
    path = root / SUBTASKS_PATH
    if not path.exists():
        raise ValueError(f"the dataset has no {SUBTASKS_PATH}: its primitives have no names")
    table = pd.read_parquet(path).sort_values("subtask_index")
    names = table["subtask"] if "subtask" in table.columns else table.index
    return [str(name) for name in names]


def _matrix(table, key: str) -> np.ndarray:
    return np.stack(table.column(key).to_numpy()).astype(np.float32)


def selected_episodes(metadata: LeRobotDatasetMetadata) -> list[int] | None:
    """Episodes that ``--dataset.episodes`` or ``--dataset.eval_split`` leave to train on; None for all.

    LeRobot gives the policy the metadata of the whole dataset, and tells the choice to the ``LeRobotDataset`` alone, which
    holds the metadata: so that is looked for among its holders.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    holders = gc.get_referrers(metadata)
    # A holder is the object itself, or the dictionary of its attributes where Python has made one.
    datasets = [item for item in gc.get_referrers(*holders) + holders if isinstance(item, LeRobotDataset)]
    chosen = [dataset.episodes for dataset in datasets if dataset.meta is metadata and dataset.episodes is not None]
    return sorted(chosen[0]) if chosen else None


class Demonstrations:
    """All frames of a dataset as tensors; ``state`` is observation.state and environment_state side by side.

    ``episodes`` are those to learn from, None for all. The others have windows too, for a loss on held-out episodes, but
    nothing that is fitted sees them.

    Raises:
        ValueError: labels that are not integers from 0 to the number of primitives - 1, or a primitive with no frames.
    """

    def __init__(
        self, metadata: LeRobotDatasetMetadata, subtask_key: str, device: str, episodes: list[int] | None = None
    ) -> None:
        root = Path(metadata.root)
        self.primitives = read_primitives(root)
        columns = [OBS_STATE, OBS_ENV_STATE, ACTION, subtask_key, "index", "episode_index"]
        files = sorted((root / "data").glob("*/*.parquet"))
        if not files:
            raise ValueError(f"{root} holds no data/*/*.parquet")
        table = parquet.ParquetDataset(files).read(columns=columns)
        table = table.take(np.argsort(table.column("index").to_numpy(), kind="stable"))
        labels = table.column(subtask_key).to_numpy()
        episode_index = table.column("episode_index").to_numpy()
        learned = np.full(len(labels), True) if episodes is None else np.isin(episode_index, episodes)
        self._check_labels(labels, labels[learned])
        new_episode = np.diff(episode_index, prepend=-1) != 0
        new_segment = new_episode | (np.diff(labels, prepend=-1) != 0)
        tensors = {
            "index": table.column("index").to_numpy().astype(np.int64),
            "state": np.concatenate([_matrix(table, OBS_STATE), _matrix(table, OBS_ENV_STATE)], axis=1),
            "action": _matrix(table, ACTION),
            "label": labels.astype(np.int64),
            "episode": np.cumsum(new_episode) - 1,
            "segment": np.cumsum(new_segment) - 1,
            "learned": learned,
        }
        if not all(np.isfinite(tensors[key]).all() for key in ("state", "action")):
            raise ValueError(f"{root} holds states or actions that are not finite")
        for name, value in tensors.items():
            setattr(self, name, torch.from_numpy(value).to(device))
        self._segment_bounds = self._bounds(new_segment, device)  # (segments, 2)
        self._episode_bounds = self._bounds(new_episode, device)  # (episodes, 2)
        self.lengths = self._lengths()

    index: Tensor
    state: Tensor
    action: Tensor
    label: Tensor
    episode: Tensor
    segment: Tensor
    learned: Tensor
    """(frames,), whether the episode is one to learn from."""

    def _check_labels(self, labels: np.ndarray, learned: np.ndarray) -> None:
        count = len(self.primitives)
        if labels.min() < 0 or labels.max() >= count:
            raise ValueError(
                f"labels go from {labels.min()} to {labels.max()}, but {SUBTASKS_PATH} names {count}: "
                f"{', '.join(self.primitives)}"
            )
        missing = [name for i, name in enumerate(self.primitives) if not (learned == i).any()]
        if missing:
            where = "the dataset" if len(learned) == len(labels) else "the dataset's chosen episodes"
            raise ValueError(f"no frame of {where} is labelled {', '.join(missing)}; there is nothing to learn it from")

    @staticmethod
    def _bounds(starts: np.ndarray, device: str) -> Tensor:
        first = np.flatnonzero(starts)
        return torch.from_numpy(np.stack([first, np.append(first[1:], len(starts))], axis=1)).to(device)

    def _lengths(self) -> list[list[int]]:
        bounds = self._segment_bounds[self.learned[self._segment_bounds[:, 0]]]
        lengths, labels = bounds[:, 1] - bounds[:, 0], self.label[bounds[:, 0]]
        runs = [lengths[labels == k] for k in range(len(self.primitives))]
        return [[int(run.min()), int(run.max())] for run in runs]

    def look_rows(self, stride: int) -> Tensor:
        """Rows to learn from at which a rollout looks: every ``stride`` frames of a primitive, or at its start alone if it
        is 0."""
        rows = self.learned.nonzero().squeeze(-1)
        elapsed = rows - self._segment_bounds[self.segment[rows], 0]
        return rows[(elapsed % stride if stride else elapsed) == 0]

    def rows(self, index: Tensor) -> Tensor:
        """Rows of the frames with these values of ``index`` (B,)."""
        rows = torch.searchsorted(self.index, index)
        if rows.max() >= len(self.index) or not torch.equal(self.index[rows], index):
            raise ValueError("the batch holds frames that the dataset on disk does not have")
        return rows

    def window(self, rows: Tensor, stride: int, length: int) -> Window:
        """Windows of ``length`` frames that the frames belong to. They start where the rollout looks: every ``stride``
        frames of a primitive, or at its start alone if ``stride`` is 0."""
        bounds = self._segment_bounds[self.segment[rows]]
        first, end = bounds.unbind(-1)
        elapsed = torch.div(rows - first, stride, rounding_mode="floor") * stride if stride else torch.zeros_like(rows)
        start = first + elapsed
        steps = start[:, None] + torch.arange(length, device=rows.device)  # (B, M)
        mask = steps < end[:, None]
        steps = torch.minimum(steps, end[:, None] - 1)
        # The last frame of an episode leads to a state that was not recorded: its own stands in.
        last = self._episode_bounds[self.episode[rows], 1][:, None] - 1
        target = torch.cat([self.action[steps], self.state[torch.minimum(steps + 1, last)]], dim=-1)
        return Window(self.state[start], self.label[start], elapsed, target, mask)

    def history(self, rows: Tensor) -> History:
        """The whole episodes that the frames belong to."""
        first, end = self._episode_bounds[self.episode[rows]].unbind(-1)
        steps = first[:, None] + torch.arange(int((end - first).max()), device=rows.device)
        mask = steps < end[:, None]
        steps = torch.minimum(steps, end[:, None] - 1)
        return History(self.state[steps], self.label[steps], mask)
