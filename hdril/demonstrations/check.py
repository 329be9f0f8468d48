"""Is a dataset what it says? Schema, frames, labels, poses, reach, success, digests, and episodes that can be made again.

Works on any LeRobot dataset of states with labelled primitives. What only hdril records, such as digests and seeds, is checked
where it is there.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hdril.demonstrations.content import CONTENT, Columns, content, dataset_digest, episode_digest
from hdril.demonstrations.provenance import RECIPE_PATH, Provenance, read_provenance
from hdril.demonstrations.read import feature_names, read_primitives
from hdril.demonstrations.record import play
from hdril.demonstrations.schema import (
    ACTION,
    DIGEST,
    DONE,
    ENVIRONMENT_STATE,
    SCENARIO,
    SEED,
    STATE,
    SUBTASK,
    SUBTASK_START,
    SUBTASKS_PATH,
    SUCCESS,
)
from hdril.geometry import POSE_AXES, Pose
from hdril.simulation.actions import ACTION_NAMES, hand_poses, openings
from hdril.simulation.inverse_kinematics import IKSettings, solve_ik
from hdril.simulation.kinematics import Chain
from hdril.simulation.robots import ROBOTS
from hdril.simulation.robots.spec import SIDES, RobotSpec

VECTORS = (STATE, ENVIRONMENT_STATE, ACTION)
UNIT = 1e-3
"""How far from 1 the length of a quaternion may be."""
INSIDE = 1e-3
"""How far beyond 0 and 1 a commanded opening may be."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong: in which episode and at which of its frames, or -1 where it is in none."""

    text: str
    episode: int = -1
    frame: int = -1

    def __str__(self) -> str:
        place = [f"episode {self.episode}"] if self.episode >= 0 else []
        place += [f"frame {self.frame}"] if self.frame >= 0 else []
        return f"{', '.join(place)}: {self.text}" if place else self.text


@dataclass(frozen=True)
class StoredFrames:
    """An episode as it is stored: its columns, and its row in the table of episodes."""

    columns: Columns
    row: Mapping[str, Any]
    first: int
    """Number of its first frame in the dataset."""

    def __len__(self) -> int:
        return len(self.columns["frame_index"])


@dataclass(frozen=True)
class Dataset:
    """What the frames of a dataset are held against."""

    names: Mapping[str, tuple[str, ...]]
    """What the numbers of each vector are called."""
    fps: float
    primitives: tuple[str, ...]
    robot: RobotSpec | None
    """None if it is none that hdril knows, or if its actions are not poses and openings of two hands."""


Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many episodes are done, and how many will be."""
Problem = tuple[int, str]
"""A frame, or -1, and what is wrong there."""


def check_dataset(
    root: Path, made_again: int | None = 0, workers: int = 1, progress: Progress | None = None
) -> Generator[Finding]:
    """What is wrong with the dataset at ``root``, as it is found.

    Args:
        made_again: how many episodes, spread over the dataset, are to be made again from recipe and seed and compared, bit for
            bit; None: all.
        workers: processes that make episodes again.
        progress: see :data:`Progress`.

    Raises:
        FileNotFoundError: there is no dataset at ``root``.
        ValueError: episodes are to be made again, and the dataset has no recipe, or ``meta/hdril.json`` is damaged.
    """
    info_file = root / "meta/info.json"
    if not info_file.exists():
        raise FileNotFoundError(f"{root} is no LeRobot dataset: it has no meta/info.json")
    info, provenance = json.loads(info_file.read_text()), read_provenance(root)
    if made_again != 0 and provenance is None:
        raise ValueError(f"{root} has no {RECIPE_PATH}: its episodes cannot be made again")
    if missing := [key for key in (*VECTORS, SUBTASK) if key not in info["features"]]:
        yield Finding(f"there is no column {', '.join(missing)}; there are: {', '.join(info['features'])}")
        return
    if not (root / SUBTASKS_PATH).exists():
        yield Finding(f"there is no {SUBTASKS_PATH}: the primitives have no names")
        return
    dataset = _describe(root, info)
    if len(set(dataset.primitives)) < len(dataset.primitives):
        yield Finding(f"{SUBTASKS_PATH} gives several primitives the same name")
    digests: list[str] = []
    total = info["total_episodes"]
    for index, found in enumerate(_episodes(root, info)):
        if isinstance(found, Finding):
            yield found
            continue
        yield from (Finding(text, index, frame) for frame, text in _problems(found, dataset))
        digests.append(str(found.row.get(DIGEST, "")))
        if progress:
            progress("checking", index + 1, total)
    yield from _check_whole(info, provenance, digests)
    if provenance is not None and made_again != 0:
        yield from _check_made_again(root, info, provenance, made_again, workers, progress)


def _describe(root: Path, info: Mapping[str, Any]) -> Dataset:
    names = {key: feature_names(key, info["features"][key]) for key in VECTORS}
    known = info.get("robot_type") in ROBOTS and names[ACTION] == ACTION_NAMES
    robot = ROBOTS[info["robot_type"]] if known else None
    return Dataset(names, float(info["fps"]), read_primitives(root), robot)


def _episodes(root: Path, info: Mapping[str, Any]) -> Iterator[StoredFrames | Finding]:
    """The episodes in order, file by file, so that one file at a time is in memory."""
    import pandas as pd
    import pyarrow as arrow

    try:
        table = pd.concat([pd.read_parquet(file) for file in sorted((root / "meta/episodes").rglob("*.parquet"))])
        rows = {int(row["episode_index"]): row for row in table.to_dict("records")}
    except (OSError, ValueError, KeyError, arrow.ArrowException) as error:
        yield Finding(f"meta/episodes cannot be read: {error}")
        rows = {}
    start = 0
    for file in sorted((root / "data").rglob("*.parquet")):
        try:
            frames = pd.read_parquet(file)
        except (OSError, ValueError, arrow.ArrowException) as error:
            yield Finding(f"{file.relative_to(root)} cannot be read: {error}")
            continue
        for index, part in frames.groupby("episode_index", sort=False):
            columns = {str(name): part[name].to_numpy() for name in part if part[name].dtype != np.dtype("O")}
            columns |= {name: np.stack(list(part[name])) for name in VECTORS}
            yield StoredFrames(columns, rows.get(int(index), {}), start)  # pyright: ignore[reportArgumentType]
            start += len(part)
    if start != info["total_frames"]:
        yield Finding(f"there are {start} frames; meta/info.json says {info['total_frames']}")


def _check_whole(info: Mapping[str, Any], provenance: Provenance | None, digests: list[str]) -> Iterator[Finding]:
    if len(digests) != info["total_episodes"]:
        yield Finding(f"there are {len(digests)} episodes; meta/info.json says {info['total_episodes']}")
    if provenance is None:
        return
    if len(digests) != len(provenance.seeds):
        yield Finding(f"there are {len(digests)} episodes; {RECIPE_PATH} has {len(provenance.seeds)} seeds")
    if provenance.digest and provenance.digest != dataset_digest(digests):
        yield Finding(f"the digest of the episodes is not the one in {RECIPE_PATH}: some are missing or others")


# --------------------------------------------------------------------- one episode


def _problems(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    if not np.isfinite(np.concatenate([episode.columns[key] for key in VECTORS], axis=1)).all():
        yield from _not_finite(episode, dataset)
        return
    for check in (_numbering, _poses, _labels, _ending, _reach, _digest):
        yield from check(episode, dataset)


def _first(mask: ArrayLike, text: str) -> Iterator[Problem]:
    """The first frame of a mask (T,), and how many more there are."""
    wrong = np.asarray(mask)
    if wrong.any():
        more = int(wrong.sum()) - 1
        yield int(wrong.argmax()), f"{text}{f', and at {more} more frames' if more else ''}"


def _not_finite(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    for key in VECTORS:
        wrong = ~np.isfinite(episode.columns[key])
        if wrong.any():
            column = int(wrong.any(0).argmax())
            yield from _first(wrong.any(1), f"{key} is not finite ({dataset.names[key][column]})")


def _numbering(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    columns, count = episode.columns, len(episode)
    numbers = np.arange(count)
    yield from _first(columns["frame_index"] != numbers, "frame_index does not count up from 0")
    yield from _first(columns["index"] != episode.first + numbers, f"index does not go on from {episode.first}")
    late = np.abs(columns["timestamp"].astype(np.float64) - numbers / dataset.fps)
    yield from _first(late > 1e-3, f"timestamp is not frame_index / {dataset.fps:g}")
    length = episode.row.get("length")
    if length != count:
        yield -1, f"it has {count} frames; meta/episodes says {length}"


def _poses(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    """Quaternions of unit length that do not change their sign, and openings from 0 to 1."""
    for key in VECTORS:
        names, values = dataset.names[key], episode.columns[key].astype(np.float64)
        for name in dict.fromkeys(name.rpartition(".")[0] for name in names):
            axes = [f"{name}.{axis}" for axis in POSE_AXES[3:]]
            if not set(axes) <= set(names):
                continue
            quaternions = values[:, [names.index(axis) for axis in axes]]
            lengths = np.linalg.norm(quaternions, axis=1)
            yield from _first(np.abs(lengths - 1.0) > UNIT, f"the quaternion of {key} {name} is not of unit length")
            flips = np.append(False, (quaternions[1:] * quaternions[:-1]).sum(1) < 0.0)
            yield from _first(flips, f"the quaternion of {key} {name} changes its sign")
    if dataset.names[ACTION] == ACTION_NAMES:
        told = openings(episode.columns[ACTION].astype(np.float64))
        wrong = (told < -INSIDE) | (told > 1.0 + INSIDE)
        yield from _first(wrong.any(1), "a commanded opening is not from 0 to 1")


def _labels(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    """Labels are in the vocabulary, and where primitives start agrees with them and with the table of episodes."""
    label, count = episode.columns[SUBTASK].astype(np.int64), len(dataset.primitives)
    unknown = (label < 0) | (label >= count)
    if unknown.any():
        yield from _first(unknown, f"{SUBTASK} is {label[unknown][0]}; {SUBTASKS_PATH} has {count} primitives")
        return
    changes = np.diff(label, prepend=-1) != 0
    starts = episode.columns[SUBTASK_START].astype(bool) if SUBTASK_START in episode.columns else changes
    yield from _first(changes & ~starts, f"{SUBTASK} changes, and {SUBTASK_START} is false")
    if "dense_subtask_start_frames" not in episode.row:
        return
    first = np.flatnonzero(starts)
    played = [dataset.primitives[k] for k in label[first]]
    told = {name: list(episode.row[f"dense_subtask_{name}"]) for name in ("names", "start_frames", "end_frames")}
    ends = [*(first[1:] - 1), len(label) - 1]
    if told != {"names": played, "start_frames": first.tolist(), "end_frames": ends}:
        yield -1, "the segments dense_subtask_… of meta/episodes are not those of the frames"


def _ending(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    """A demonstration ends in success, once."""
    last = np.arange(len(episode)) == len(episode) - 1
    for key in (DONE, SUCCESS):
        if key in episode.columns:
            told = episode.columns[key].astype(bool)
            yield from _first(told & ~last, f"{key} is true before the last frame")
            if not told[-1]:
                yield len(episode) - 1, f"{key} is false in the last frame"


def _reach(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    """Hands reach what they are told to reach."""
    if dataset.robot is None:
        return
    poses = hand_poses(episode.columns[ACTION].astype(np.float64))
    settings = replace(IKSettings(), max_joint_step=np.inf)
    base = dataset.robot.base.inverse()
    for i, side in enumerate(SIDES):
        chain, joints = _chain(dataset.robot.name, side), np.array(dataset.robot.arms[side].posture)
        far = np.zeros(len(poses))
        for frame, pose in enumerate(poses[:, i]):
            found = solve_ik(chain, base @ Pose.from_vector(pose), joints, joints, settings)
            far[frame] = 0.0 if found.ok else max(found.position_error, 1e-3)
            joints = found.joints if found.ok else joints
        yield from _first(
            far > 0.0, f"the {side} hand does not reach its command, by {100.0 * far.max():.1f} cm at most"
        )


@cache
def _chain(robot: str, side: str) -> Chain:
    spec = ROBOTS[robot]
    return Chain(spec.source(), spec.base_link, spec.arms[side].tool)


def _digest(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    told = episode.row.get(DIGEST)
    if told and told != episode_digest(episode.columns, int(episode.row[SEED]), episode.row[SCENARIO]):
        yield -1, "its content has another digest than meta/episodes says: it was changed after it was recorded"


# --------------------------------------------------------------------- made again


def _check_made_again(
    root: Path,
    info: Mapping[str, Any],
    provenance: Provenance,
    wanted: int | None,
    workers: int,
    progress: Progress | None,
) -> Iterator[Finding]:
    """Compare episodes with what recipe and seed make now, bit for bit."""
    count = len(provenance.seeds)
    chosen = range(count) if wanted is None else np.unique(np.linspace(0, count - 1, min(wanted, count)).astype(int))
    stored = (
        (index, found)
        for index, found in enumerate(found for found in _episodes(root, info) if isinstance(found, StoredFrames))
        if index in set(chosen)
    )
    again = play(provenance.recipe, [provenance.seeds[i] for i in chosen], workers)
    for done, ((index, old), new) in enumerate(zip(stored, again, strict=False), 1):
        yield from (Finding(text, index, frame) for frame, text in _compare(old, content(new), new.scenario))
        if progress:
            progress("making again", done, len(chosen))


def _compare(old: StoredFrames, new: Columns, scenario: str) -> Iterator[Problem]:
    """The first frame at which an episode made again is another."""
    again = "made again from its recipe and seed, "
    if old.row.get(SCENARIO, scenario) != scenario:
        yield -1, f"{again}it has another scenario"
        return
    for name in (name for name in CONTENT if name in old.columns):
        before, now = old.columns[name], new[name]
        count = min(len(before), len(now))
        wrong = (before[:count] != now[:count]).reshape(count, -1).any(1)
        if wrong.any():
            gap = np.abs(before[:count].astype(np.float64) - now[:count].astype(np.float64)).max()
            yield int(wrong.argmax()), f"{again}it has another {name} from here on, by up to {gap:.2g}"
            return
    if len(old) != len(new[DONE]):
        yield -1, f"{again}it has {len(new[DONE])} frames and not {len(old)}"
