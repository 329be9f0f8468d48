"""The dataset's low-dimensional columns, held in memory, and windows of them by frame index.

LeRobot's loader can cut windows itself, through delta timestamps, but at batch 70 it gives 70 to 540 of them a second.
Single frames come at thousands a second, and a gather from memory gives 90,000. So the loader yields single frames, and
the policy uses their ``index`` alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet as parquet
import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor
from torch.nn import functional as F

from lerobot_policy_hdril.forms import assign, find_forms, halves
from lerobot_policy_hdril.schema import LANGUAGE, LANGUAGE_STYLE, SUBTASK_KEY, SUBTASK_START, SUBTASKS_PATH

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

LATEST = 6
"""Frames by which a planner is told of a beginning too late, at most."""


@dataclass(frozen=True)
class Window:
    """The rest of a primitive from a frame on, for B samples, padded to M frames.

    ``seen`` (B, 1 + W, S) is the state at the start, and beside it W means of the last ones; ``elapsed`` (B,) how many
    frames of the primitive are over by then, and ``first`` (B,) whether it is the first one of its episode; ``target``
    (B, M, A + S) the actions and the states that they lead to; ``mask`` (B, M) is True on real frames.
    """

    seen: Tensor
    primitive: Tensor  # (B,)
    elapsed: Tensor
    first: Tensor
    target: Tensor
    mask: Tensor

    @property
    def state(self) -> Tensor:
        """(B, S), at the start."""
        return self.seen[:, 0]


@dataclass(frozen=True)
class History:
    """Whole episodes for B samples, padded to T frames: states (B, T, S), and the rest (B, T).

    ``begins`` is True where a primitive begins; ``playing`` is the one of the frame before, K where there is none, and
    ``elapsed`` how many of its frames are over.
    """

    state: Tensor
    primitive: Tensor
    begins: Tensor
    playing: Tensor
    elapsed: Tensor
    mask: Tensor

    def late(self, share: float, generator: torch.Generator) -> History:
        """The same episodes, told as by a player that is late: at ``share`` of the beginnings it begins the primitive 1 to
        :data:`LATEST` frames later. Until then the one before plays on, and at each of these frames the primitive ``begins``.

        The first beginning of an episode is never late, because nothing plays before it, and none lasts as long as the primitive.
        States and what is right to play stay as they are.
        """
        batch, time = self.begins.shape
        frames = torch.arange(time, device=self.begins.device)
        begun = torch.where(self.begins, frames, 0).cummax(1).values  # where the run of each frame begins
        coming = torch.where(self.begins, frames, time).flip(1).cummin(1).values.flip(1)
        end = torch.minimum(F.pad(coming[:, 1:], (0, 1), value=time), self.mask.sum(1, keepdim=True))
        drawn = torch.rand(batch, time, generator=generator, device=frames.device) < share
        delay = torch.randint(1, LATEST + 1, (batch, time), generator=generator, device=frames.device)
        delay = torch.minimum(delay, end - frames - 1).clamp_min(0).where(self.begins & drawn & (frames > 0), 0)
        mine = delay.gather(1, begun)
        before = delay.gather(1, begun.gather(1, (frames - 1).clamp_min(0).expand(batch, -1)))
        since = frames - begun
        missed = since <= mine
        elapsed = torch.where(missed, (self.elapsed - before).gather(1, begun) + since, since - mine)
        playing = torch.where(missed, self.playing.gather(1, begun), self.playing)
        begins = self.begins | (missed & (mine > 0))
        return replace(self, playing=playing, elapsed=elapsed, begins=begins)


@dataclass(frozen=True)
class Replay:
    """Whole episodes: their first states (E, S), and their actions (E, T, A), the last one repeated to the end."""

    state: Tensor
    action: Tensor


def read_primitives(root: Path) -> list[str]:
    """Names of the primitives in the order of their labels.

    Raises:
        ValueError: the dataset does not say what its labels mean.
    """
    path = root / SUBTASKS_PATH
    if not path.exists():
        raise ValueError(f"the dataset has no {SUBTASKS_PATH}: its primitives have no names")
    table = pd.read_parquet(path).sort_values(SUBTASK_KEY)
    names = table["subtask"] if "subtask" in table.columns else table.index
    return [str(name) for name in names]


def _read_columns(root: Path, subtask_key: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """The columns in the order of ``index``, and the names of the primitives; ``state`` is observation.state and
    environment_state side by side."""
    files = sorted((root / "data").glob("*/*.parquet"))
    if not files:
        raise ValueError(f"{root} holds no data/*/*.parquet")
    source = parquet.ParquetDataset(files)
    there = source.schema.names
    in_words = subtask_key not in there
    marked = subtask_key == SUBTASK_KEY and SUBTASK_START in there
    labels = [LANGUAGE, "timestamp"] if in_words else [subtask_key, *([SUBTASK_START] if marked else [])]
    table = source.read(columns=[OBS_STATE, OBS_ENV_STATE, ACTION, "index", "episode_index", *labels])
    table = table.take(np.argsort(table.column("index").to_numpy(), kind="stable"))
    columns = {
        "state": np.concatenate([_matrix(table, OBS_STATE), _matrix(table, OBS_ENV_STATE)], axis=1),
        "action": _matrix(table, ACTION),
        "index": table.column("index").to_numpy().astype(np.int64),
        "episode_index": table.column("episode_index").to_numpy().astype(np.int64),
    }
    if not all(np.isfinite(columns[key]).all() for key in ("state", "action")):
        raise ValueError(f"{root} holds states or actions that are not finite")
    if in_words:
        columns["label"], columns["start"], primitives = _read_words(root, table, columns["episode_index"])
        return columns, primitives
    columns["label"] = table.column(subtask_key).to_numpy().astype(np.int64)
    if marked:
        columns["start"] = table.column(SUBTASK_START).to_numpy().astype(bool)
    return columns, read_primitives(root)


def _read_words(root: Path, table: pyarrow.Table, episodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Labels and starts (N,), and the primitives, from LeRobot's language rows; every frame of an episode holds them all.

    The words are what counts, because :data:`SUBTASKS_PATH` may be older: those that it names come first, in its order, then the
    others as they first appear.
    """
    first = np.flatnonzero(np.diff(episodes, prepend=-1) != 0)
    begins = [_begins(root, int(episodes[at]), table.column(LANGUAGE)[int(at)].as_py()) for at in first]
    words = dict.fromkeys(name for episode in begins for _, name in episode)
    named = read_primitives(root) if (root / SUBTASKS_PATH).exists() else ()
    primitives = [name for name in dict.fromkeys((*named, *words)) if name in words]
    time, label = table.column("timestamp").to_numpy(), np.zeros(len(episodes), np.int64)
    start = np.zeros(len(episodes), bool)
    for begin, end, episode in zip(first, [*first[1:], len(episodes)], begins, strict=True):
        # Times are kept as float32 in some files and as float64 in others.
        frames = np.searchsorted(time[begin:end], np.array([at for at, _ in episode]) - 1e-4)
        where = f"{root}, episode {episodes[begin]}: its rows of the style {LANGUAGE_STYLE!r}"
        if frames[0] > 0 or frames[-1] >= end - begin or (np.diff(frames) <= 0).any():
            raise ValueError(f"{where} must begin with the first frame, and no two at the same")
        start[begin + frames] = True
        counts = np.diff([*frames, end - begin])
        label[begin:end] = np.repeat([primitives.index(name) for _, name in episode], counts)
    return label, start, primitives


def _begins(root: Path, episode: int, rows: list[dict] | None) -> list[tuple[float, str]]:
    """When each primitive of an episode begins, s, and its name."""
    mine = [row for row in rows or () if row["style"] == LANGUAGE_STYLE and row["content"]]
    if not mine:
        raise ValueError(f"{root}, episode {episode}: {LANGUAGE} has no row of the style {LANGUAGE_STYLE!r}")
    return sorted((float(row["timestamp"]), str(row["content"])) for row in mine)


def _matrix(table: pyarrow.Table, key: str) -> np.ndarray:
    return np.stack(list(table.column(key).to_numpy())).astype(np.float32)


def _check_labels(labels: np.ndarray, primitives: list[str]) -> None:
    if labels.min() < 0 or labels.max() >= len(primitives):
        raise ValueError(
            f"labels go from {labels.min()} to {labels.max()}, but {SUBTASKS_PATH} names {len(primitives)}: "
            f"{', '.join(primitives)}"
        )
    if missing := [name for i, name in enumerate(primitives) if not (labels == i).any()]:
        raise ValueError(f"no frame of the dataset is labelled {', '.join(missing)}; there is nothing to learn it from")


def _digest(columns: dict[str, np.ndarray], primitives: list[str]) -> str:
    """SHA-256 of what the policy reads, whatever the files and the byte order of the machine."""
    result = hashlib.sha256(json.dumps(primitives).encode())
    for name in sorted(columns):
        values = np.ascontiguousarray(columns[name])
        result.update(f"{name} {values.dtype.name} {values.shape}".encode())
        result.update(values.astype(values.dtype.newbyteorder("<"), copy=False).data)
    return result.hexdigest()


class Demonstrations:
    """All frames of a dataset as tensors. Episodes are counted from 0 in the order of their frames.

    Nothing here is learned: which episodes are learned from is known when the loader yields their frames, see
    :mod:`lerobot_policy_hdril.fitting`. Methods that fit anything therefore take a mask (E,) of episodes.

    Args:
        metadata: of the dataset.
        subtask_key: column that labels each frame with its primitive.
        device: where the tensors are.
        filters: lengths of the W means of the last states that are beside each state, frames.
        halved: columns of the action that tell the forms of a primitive apart; none: each has one form.
        forms: those of a checkpoint; empty for those of the dataset.

    Raises:
        ValueError: labels that are not integers from 0 to the number of primitives - 1, or a primitive with no frames.
    """

    def __init__(
        self,
        metadata: LeRobotDatasetMetadata,
        subtask_key: str,
        device: str,
        filters: Sequence[int] = (),
        halved: Sequence[int] = (),
        forms: Sequence[Sequence[int]] = (),
    ) -> None:
        root = Path(metadata.root)
        columns, self.primitives = _read_columns(root, subtask_key)
        _check_labels(columns["label"], self.primitives)
        self.digest = _digest(columns, self.primitives)
        new_episode = np.diff(columns["episode_index"], prepend=-1) != 0
        new_segment = new_episode | (np.diff(columns["label"], prepend=-1) != 0)
        if "start" in columns:
            new_segment |= columns["start"]
        begins = np.flatnonzero(new_segment)
        named, grips = columns["label"][begins], columns["action"][:, list(halved)]
        half = halves(grips[begins], grips)
        self.forms = [tuple(form) for form in forms] or find_forms(named, half, len(self.primitives))
        """What the labels are of."""
        columns["label"] = np.repeat(assign(named, half, self.forms), np.diff([*begins, len(new_segment)]))
        self.episode_index: list[int] = columns["episode_index"][new_episode].tolist()
        """What the dataset calls each episode."""
        self.index, self.state, self.action, self.label, self.episode, self.segment = (
            torch.from_numpy(values).to(device)
            for values in (
                columns["index"],
                columns["state"],
                columns["action"],
                columns["label"],
                np.cumsum(new_episode) - 1,
                np.cumsum(new_segment) - 1,
            )
        )
        self._segment_bounds = self._bounds(new_segment, device)  # (segments, 2)
        self._episode_bounds = self._bounds(new_episode, device)  # (E, 2)
        self.longest = int((self._segment_bounds[:, 1] - self._segment_bounds[:, 0]).max())
        """Frames of the longest segment."""
        self.seen = torch.stack([self.state, *(self._mean(frames) for frames in filters)], dim=1)
        """(N, 1 + W, S): the states, and for each filter the mean of the last so many of the episode, or of those there are."""

    def _mean(self, frames: int) -> Tensor:
        sums = torch.cat([torch.zeros_like(self.state[:1]), self.state], dim=0).double().cumsum(0)
        last = torch.arange(len(self.state), device=self.state.device)
        first = torch.maximum(self._episode_bounds[self.episode, 0], last + 1 - frames)
        return ((sums[last + 1] - sums[first]) / (last + 1 - first)[:, None]).to(self.state)

    @staticmethod
    def _bounds(starts: np.ndarray, device: str) -> Tensor:
        first = np.flatnonzero(starts)
        return torch.from_numpy(np.stack([first, np.append(first[1:], len(starts))], axis=1)).to(device)

    @property
    def longest_episode(self) -> int:
        """Frames of the longest episode."""
        return int((self._episode_bounds[:, 1] - self._episode_bounds[:, 0]).max())

    def episodes(self, chosen: Tensor, length: int) -> Replay:
        """Episodes (E,), counted from 0, in ``length`` frames."""
        first, end = self._episode_bounds[chosen].unbind(-1)
        steps = first[:, None] + torch.arange(length, device=first.device)
        return Replay(self.state[first], self.action[torch.minimum(steps, end[:, None] - 1)])

    def lengths(self, episodes: Tensor) -> list[list[int]]:
        """Shortest and longest run of each primitive in these episodes, frames; [0, 0] for one that is not among them.

        A run at the end of an episode may be cut by it: it is the shortest only if the primitive has no other.
        """
        bounds = self._segment_bounds[episodes[self.episode[self._segment_bounds[:, 0]]]]
        lengths, labels = bounds[:, 1] - bounds[:, 0], self.label[bounds[:, 0]]
        whole = bounds[:, 1] < self._episode_bounds[self.episode[bounds[:, 0]], 1]
        runs = [(lengths[labels == k], lengths[(labels == k) & whole]) for k in range(len(self.forms))]
        return [
            [int((inner if len(inner) else run).min()), int(run.max())] if len(run) else [0, 0] for run, inner in runs
        ]

    def beginnings(self, episodes: Tensor) -> Tensor:
        """How often each primitive begins after each, and first of all (K + 1, K), in these episodes."""
        first = self._segment_bounds[episodes[self.episode[self._segment_bounds[:, 0]]], 0]
        fresh = first == self._episode_bounds[self.episode[first], 0]
        count = len(self.forms)
        before = torch.where(fresh, count, self.label[(first - 1).clamp_min(0)])
        return (before * count + self.label[first]).bincount(minlength=(count + 1) * count).unflatten(0, (-1, count))

    def replan_rows(self, stride: int, episodes: Tensor) -> Tensor:
        """Rows of these episodes at which a running policy makes a plan: every ``stride`` frames of a primitive, or at its
        start alone if ``stride`` is 0."""
        rows = episodes[self.episode].nonzero().squeeze(-1)
        elapsed = rows - self._segment_bounds[self.segment[rows], 0]
        return rows[(elapsed % stride if stride else elapsed) == 0]

    def rows(self, index: Tensor) -> Tensor:
        """Rows of the frames with these values of ``index`` (B,).

        Raises:
            ValueError: the dataset has no such frame.
        """
        rows = torch.searchsorted(self.index, index)
        if rows.max() >= len(self.index) or not torch.equal(self.index[rows], index):
            raise ValueError("the batch holds frames that the dataset on disk does not have")
        return rows

    def window(self, rows: Tensor, stride: int, length: int) -> Window:
        """Windows of ``length`` frames that the frames belong to. They start where a running policy makes a plan: every
        ``stride`` frames of a primitive, or at its start alone if ``stride`` is 0."""
        bounds = self._segment_bounds[self.segment[rows]]
        first, end = bounds.unbind(-1)
        elapsed = torch.div(rows - first, stride, rounding_mode="floor") * stride if stride else torch.zeros_like(rows)
        start = first + elapsed
        steps = start[:, None] + torch.arange(length, device=rows.device)  # (B, M)
        mask = steps < end[:, None]
        steps = torch.minimum(steps, end[:, None] - 1)
        # The last frame of an episode leads to a state that was not recorded: its own stands in.
        opening, ending = self._episode_bounds[self.episode[rows]].unbind(-1)
        last = ending[:, None] - 1
        target = torch.cat([self.action[steps], self.state[torch.minimum(steps + 1, last)]], dim=-1)
        return Window(self.seen[start], self.label[start], elapsed, first == opening, target, mask)

    def history(self, rows: Tensor) -> History:
        """The whole episodes that the frames belong to."""
        first, end = self._episode_bounds[self.episode[rows]].unbind(-1)
        steps = first[:, None] + torch.arange(int((end - first).max()), device=rows.device)
        mask = steps < end[:, None]
        steps = torch.minimum(steps, end[:, None] - 1)
        since = self._segment_bounds[self.segment[steps], 0]
        begins, before = steps == since, (steps - 1).clamp_min(0)
        fresh = steps == first[:, None]
        playing = torch.where(fresh, len(self.forms), self.label[before])
        elapsed = torch.where(fresh, 0, steps - self._segment_bounds[self.segment[before], 0])
        return History(self.state[steps], self.label[steps], begins, playing, elapsed, mask)
