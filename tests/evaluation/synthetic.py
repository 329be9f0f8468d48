"""Episodes made by hand, for tests of scores and reports: no simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hdril.actor import Explanation
from hdril.evaluation.reference import Reference
from hdril.evaluation.score import Outcome
from hdril.rollout import Ending
from hdril.tasks import Task, get_task
from hdril.trace import Trace

TASK = replace(get_task("table_lift"), primitives=get_task("table_lift").primitives[:3])
"""Three primitives: grasp, move, lift. One observed object."""
SUCCEEDED, FAILED = Ending(True, "", 6), Ending(False, "table upright", 6)


def explanation(label: int, probabilities: Sequence[float] | None = None, count: int = 3) -> Explanation:
    """A primitive that plays, and the planner's probabilities: all on that primitive unless given."""
    values = np.eye(count)[label] if probabilities is None else np.array(probabilities)
    return Explanation(label, values.astype(np.float32))


def trace(
    labels: Sequence[int] = (0, 0, 1, 1, 2, 2),
    explanations: Sequence[Explanation | None] | None = None,
    task: Task = TASK,
) -> Trace:
    """Hands and objects move 1 cm a frame along x, far apart along y. ``labels`` are the expert's primitives by frame."""
    frames, objects = len(labels), len(task.observed)
    state = np.zeros((frames + 1, 2, 8), np.float32)
    things = np.zeros((frames + 1, objects, 7), np.float32)
    for rows in (state, things):
        rows[..., 0] = 0.01 * np.arange(frames + 1)[:, None]
        rows[..., 1] = np.arange(rows.shape[1])
        rows[..., 6] = 1.0
    return Trace(
        state=state.reshape(frames + 1, 16),
        environment_state=things.reshape(frames + 1, 7 * objects).copy(),
        action=state[:-1].reshape(frames, 16),
        joints=np.zeros((frames + 1, 18)),
        reward=np.zeros(frames, np.float32),
        scripted=np.array(labels, np.int64),
        explanations=tuple(explanations if explanations is not None else [explanation(max(k, 0)) for k in labels]),
        ik_failures=("",) * frames,
        stage=np.zeros(frames + 1, np.int64),
        measures=np.zeros((frames + 1, len(task.measures))),
        ik_error=np.zeros((frames, 2)),
        grip_force=np.zeros((frames + 1, 2)),
        contacts={},
        poses={name: things[:, i].astype(np.float64) for i, name in enumerate(task.observed)},
        held={name: np.zeros((frames + 1, 2), np.bool_) for name in task.observed},
        peak_force=np.zeros(frames + 1),
        events=("",) * frames,
        scenario=task.sample(0),
    )


def moved(episode: Trace, first_row: int, offset: Sequence[float], hand: int | None = None) -> Trace:
    """A trace whose hand (0, 1), or whose object if ``hand`` is None, is ``offset`` (3,), m, away from ``first_row`` on."""
    if hand is None:
        (name,) = episode.poses
        poses = episode.poses[name].copy()
        poses[first_row:, :3] += offset
        return replace(episode, poses={name: poses})
    state = episode.state.copy()
    state[first_row:, 8 * hand : 8 * hand + 3] += np.asarray(offset, np.float32)
    return replace(episode, state=state)


def reference(episode: Trace, success: bool = True, task: Task = TASK) -> Reference:
    """The expert's episode: that of ``episode``."""
    return Reference.of(task, episode, SUCCEEDED if success else FAILED)


def outcome(seed: int, **changes: Any) -> Outcome:
    """A success on ``table_lift`` with small errors, or what ``changes`` make of it."""
    confusion = np.diag([10, 12, 12, 12, 12, 12]).tolist()
    labels = get_task("table_lift").labels
    good = Outcome(
        seed=seed, success=True, unmet="", frames=70, ik_failures=0, position_error_cm=0.2, angle_error_rad=0.002,
        dtw_cm=0.1, position_error_cm_by_primitive=dict.fromkeys(labels, 0.2), start=(0.6, 0.1), primitives=labels,
        expert_primitives=labels, stage="success", planner_confusion=confusion, planner_boundary_hits=[True] * 6,
    )  # fmt: skip
    return replace(good, **changes)
