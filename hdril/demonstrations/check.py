"""Is a dataset what it says? Schema, frames, labels, poses, reach, success, digests, and episodes that can be made again.

Works on any LeRobot dataset of states whose primitives are labelled in ``subtask_index``. What only hdril records, such as
digests and seeds, is checked where it is there.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hdril.demonstrations.content import CONTENT, dataset_digest, episode_digest
from hdril.demonstrations.frames import VECTORS, Finding, StoredFrames, read_frames, read_rows
from hdril.demonstrations.provenance import RECIPE_PATH, read_provenance
from hdril.demonstrations.read import feature_names, read_info, read_primitives
from hdril.demonstrations.remake import choose, compare_with_remade
from hdril.demonstrations.schema import (
    ACTION,
    DIGEST,
    DONE,
    SCENARIO,
    SEED,
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

UNIT = 1e-3
"""How far from 1 the length of a quaternion may be."""
INSIDE = 1e-3
"""How far beyond 0 and 1 a commanded opening may be."""


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
        root: folder of the dataset.
        made_again: how many episodes, spread over the dataset, are to be made again from recipe and seed and compared, number
            for number; None: all.
        workers: processes that make episodes again.
        progress: see :data:`Progress`.

    Raises:
        FileNotFoundError: there is no dataset at ``root``.
        ValueError: episodes are to be made again, and the dataset has no recipe; ``meta/info.json`` or ``meta/hdril.json`` is
            damaged.
    """
    info, provenance = read_info(root), read_provenance(root)
    if made_again != 0 and provenance is None:
        raise ValueError(f"{root} has no {RECIPE_PATH}: its episodes cannot be made again")
    if missing := [key for key in (*VECTORS, SUBTASK) if key not in info["features"]]:
        yield Finding(f"columns are missing: {', '.join(missing)}; there are: {', '.join(info['features'])}")
        return
    dataset = yield from _describe(root, info)
    if dataset is None:
        return
    rows = yield from _rows(root)
    total, seen, digests = info["total_episodes"], set[int](), list[str]()
    chosen = set() if made_again == 0 or provenance is None else set(choose(len(provenance.seeds), made_again))
    stored: list[StoredFrames] = []
    for found in read_frames(root, info, rows):
        if isinstance(found, Finding):
            yield found
            seen |= {found.episode} - {-1}
            continue
        seen.add(found.index)
        yield from (Finding(text, found.index, frame) for frame, text in _problems(found, dataset))
        digests.append(str(found.row.get(DIGEST, "")))
        if found.index in chosen:
            stored.append(found)
        if progress:
            progress("checking", len(seen), total)
    if missing := sorted(set(range(total)) - seen):
        yield Finding(f"episodes are missing: {', '.join(map(str, missing[:10]))}{', …' if len(missing) > 10 else ''}")
    if provenance is None:
        return
    if total != len(provenance.seeds):
        yield Finding(
            f"meta/info.json says that there are {total} episodes; {RECIPE_PATH} has {len(provenance.seeds)} seeds"
        )
    if rows and provenance.digest and provenance.digest != dataset_digest(digests):
        yield Finding(f"the digest of all episodes is not the one in {RECIPE_PATH}")
    if stored:  # no simulator is started for nothing
        yield from compare_with_remade(stored, provenance, workers, progress)


def _describe(root: Path, info: Mapping[str, Any]) -> Generator[Finding, None, Dataset | None]:
    try:
        primitives = read_primitives(root)
    except (ValueError, KeyError, OSError) as error:
        yield Finding(f"the names of the primitives cannot be read: {error}")
        return None
    if len(set(primitives)) < len(primitives):
        yield Finding(f"{SUBTASKS_PATH} gives several primitives the same name")
    names = {key: feature_names(key, info["features"][key]) for key in VECTORS}
    known = info.get("robot_type") in ROBOTS and names[ACTION] == ACTION_NAMES
    return Dataset(names, float(info["fps"]), primitives, ROBOTS[info["robot_type"]] if known else None)


def _rows(root: Path) -> Generator[Finding, None, dict[int, dict[str, Any]]]:
    try:
        return read_rows(root)
    except ValueError as error:
        yield Finding(str(error))
        return {}


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
        yield int(wrong.argmax()), f"{text}{f', and in {more} more frame{"s" * (more > 1)}' if more else ''}"


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
    length = episode.row.get("length", count)
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
    empty = ~np.isfinite(episode.columns[SUBTASK].astype(np.float64))
    if empty.any():
        yield from _first(empty, f"{SUBTASK} is empty")
        return
    label, count = episode.columns[SUBTASK].astype(np.int64), len(dataset.primitives)
    unknown = (label < 0) | (label >= count)
    if unknown.any():
        yield from _first(unknown, f"{SUBTASK} is {label[unknown][0]}; {SUBTASKS_PATH} has {count} primitives")
        return
    changes = np.diff(label, prepend=-1) != 0
    starts = episode.columns[SUBTASK_START].astype(bool) if SUBTASK_START in episode.columns else changes
    yield from _first(changes & ~starts, f"{SUBTASK} changes, and {SUBTASK_START} is false")
    segments = [episode.row.get(f"dense_subtask_{name}") for name in ("names", "start_frames", "end_frames")]
    if any(segment is None for segment in segments):
        return  # they are for SARM, and need not be there
    first = np.flatnonzero(starts)
    played = [dataset.primitives[k] for k in label[first]]
    ends = [*(first[1:] - 1), len(label) - 1]
    if [list(segment) for segment in segments if segment is not None] != [played, first.tolist(), ends]:
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
        posture, reasons = joints, [""] * len(poses)
        for frame, pose in enumerate(poses[:, i]):
            if np.linalg.norm(pose[3:]) < 0.5:
                continue  # no rotation: another finding
            found = solve_ik(chain, base @ Pose.from_vector(pose), joints, posture, settings)
            joints, reasons[frame] = (found.joints, "") if found.ok else (joints, found.reason)
        first = next((reason for reason in reasons if reason), "")
        yield from _first([bool(reason) for reason in reasons], f"the command of the {side} hand is {first}")


@cache
def _chain(robot: str, side: str) -> Chain:
    spec = ROBOTS[robot]
    return Chain(spec.source(), spec.base_link, spec.arms[side].tool)


def _digest(episode: StoredFrames, dataset: Dataset) -> Iterator[Problem]:
    told = episode.row.get(DIGEST)
    if not told:
        return
    missing = [name for name in CONTENT if name not in episode.columns]
    missing += [name for name in (SEED, SCENARIO) if episode.row.get(name) is None]
    if missing:
        yield -1, f"its digest cannot be checked: {', '.join(missing)} is missing"
    elif told != episode_digest(episode.columns, int(episode.row[SEED]), str(episode.row[SCENARIO])):
        yield -1, "its digest is not the one in meta/episodes: it was changed after it was recorded"
