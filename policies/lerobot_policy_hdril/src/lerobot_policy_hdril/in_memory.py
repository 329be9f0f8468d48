"""``lerobot-train`` with the frames of the dataset in memory: the same batches, sooner.

A policy that learns from windows of frames, such as ACT (a chunk of actions) or Diffusion (a horizon), spends most of its time on
one core in LeRobot's loader, which reads every window from Arrow files. Use it like ``lerobot-train``, with the same options:

    python -m lerobot_policy_hdril.in_memory --policy.type=act --num_workers=0 …

Images and videos are read as ever. HDR-IL needs none of this: it asks the loader for single frames.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig

    from datasets import Dataset


class FramesInMemory:
    """What LeRobot's reader asks of its table of N frames, answered from tensors.

    ``frames[i]`` is a frame, ``frames[[i, …]]`` a list for each column, ``frames[name][[i, …]]`` the frames of a column. What is
    neither a number nor a vector stays on disk.
    """

    def __init__(self, table: Dataset) -> None:
        self._table = table
        first = table[0]
        self._columns = {
            name: _read(table, name, value)
            for name, value in first.items()
            if isinstance(value, Tensor) and value.ndim < 2
        }
        others = [name for name in table.column_names if name not in self._columns]
        self._others = table.select_columns(others) if others else None

    def __len__(self) -> int:
        return len(self._table)

    @property
    def data(self) -> Any:
        """The Arrow table."""
        return self._table.data

    def __getitem__(self, key: int | str | list[int]) -> Any:
        if isinstance(key, str):
            return _Column(self._columns[key]) if key in self._columns else self._table[key]
        others = self._others[key] if self._others is not None else {}
        if isinstance(key, list):
            return {name: list(values[key]) for name, values in self._columns.items()} | others
        return {name: values[key] for name, values in self._columns.items()} | others


class _Column:
    """Frames of one column, as a list of tensors."""

    def __init__(self, values: Tensor) -> None:
        self._values = values

    def __getitem__(self, rows: list[int]) -> list[Tensor]:
        return list(self._values[rows])


def _read(table: Dataset, name: str, example: Tensor) -> Tensor:
    """A column (N, …), with the type that the table gives to each of its frames."""
    return torch.from_numpy(np.array(table.with_format("numpy")[name][:])).to(example.dtype)


def hold[T](dataset: T) -> T:
    """Let a dataset answer from memory; returns it.

    Raises:
        ValueError: it is streamed.
    """
    if not isinstance(dataset, LeRobotDataset):
        raise ValueError("frames in memory are not for --dataset.streaming=true")
    frames = FramesInMemory(dataset.hf_dataset)
    reader: Any = dataset.reader  # made by now; it takes anything that answers as its table does
    reader.hf_dataset = frames
    return dataset


def main() -> None:
    """Entry point."""
    from lerobot.scripts import lerobot_train

    make = lerobot_train.make_train_eval_datasets

    def make_in_memory(cfg: TrainPipelineConfig) -> Any:
        return tuple(dataset and hold(dataset) for dataset in make(cfg))

    lerobot_train.make_train_eval_datasets = make_in_memory  # LeRobot has no hook for a dataset
    lerobot_train.main()


if __name__ == "__main__":
    main()
