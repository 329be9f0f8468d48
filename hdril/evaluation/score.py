"""How one episode went."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hdril.evaluation.metrics import trajectory_error
from hdril.evaluation.motion import Motion, jerk, motion
from hdril.evaluation.reference import Reference, observed_poses
from hdril.rollout import Ending
from hdril.simulation.actions import hand_poses
from hdril.tasks import Task
from hdril.trace import Trace

DEPARTURE = 0.02
"""m from the expert at which an episode counts as having left its path. No successful episode of `make demo` goes so far."""
MIN_PROBABILITY_SUM = 0.999
"""Least sum of the planner's probabilities over the task's primitives at which the planner is scored."""


@dataclass(frozen=True)
class Outcome:
    """How one episode went. Errors are against the noise-free expert on the same seed."""

    seed: int
    success: bool
    unmet: str
    """The conditions of success that do not hold at the end, separated by commas; empty after a success."""
    frames: int
    ik_failures: int
    """Frames at which inverse kinematics found no solution for a command."""
    position_error_cm: float
    """Distance of the hands from the expert's, cm, mean over frames and hands."""
    angle_error_rad: float
    """Angle between the hands' orientations and the expert's, rad, mean over frames and hands."""
    dtw_cm: float
    """Mean distance along the optimal warping path, cm, mean of both hands (:func:`hdril.evaluation.metrics.dtw_distance`)."""
    position_error_cm_by_primitive: dict[str, float]
    """The position error over the frames of each primitive of the expert, cm."""
    start: tuple[float, ...]
    """x and y of every observed object at the start, m."""
    primitives: tuple[str, ...] = ()
    """What the policy played, in order; empty if it has no primitives."""
    expert_primitives: tuple[str, ...] = ()
    """What the expert plays in this scene, in order."""
    stage: str = ""
    """The last of the task's stages that was reached; empty if none was."""
    measures: dict[str, float] = field(default_factory=dict)
    """The task's measures at the end."""
    planner_confusion: list[list[int]] = field(default_factory=list)
    """Frames of the expert's primitive (row) at which the planner preferred each (column); empty without a planner whose
    primitives are the task's."""
    planner_boundary_hits: list[bool] = field(default_factory=list)
    """For each primitive of the expert, whether the planner preferred it at its first frame."""
    departed_frame: int = -1
    """First frame at whose end a hand or an object is more than :data:`DEPARTURE` from where the expert has it; -1: none."""
    departed_in: str = ""
    """The primitive that was played then (the expert's, if the policy has none)."""
    expert_success: bool = True
    """Whether the expert solves the scene of this seed. If not, the errors above say nothing about the policy."""
    motion: dict[str, float] = field(default_factory=dict)
    """How the hands moved (:class:`hdril.evaluation.motion.Motion`), in the units that the names end with."""
    expert_jerk_m_s3: float = 0.0
    """Root mean square of the jerk of the expert's hands in this scene, m/s³; 0 if it was not computed."""
    stages: int = 0
    """How many of the task's stages were reached; success counts as one more."""
    events: tuple[tuple[int, str], ...] = ()
    """What happened to the episode: frames, and events in words."""
    noticed: tuple[tuple[int, str], ...] = ()
    """What the policy said that it noticed, by ``explain()``: frames, and its words; empty if it says nothing."""
    scenario: str = ""
    """The scene and what happened to it, as JSON (:class:`hdril.tasks.scenario.Scenario`)."""


LISTED = 5
"""Times of one thing that are told one by one."""


def in_words(happened: Sequence[tuple[int, str]], period: float) -> str:
    """What happened or was noticed, by frame, each thing once with its times, for a ``period`` of control in s.

    Of many times, the first :data:`LISTED` and the last are told: a policy may try a grasp again for a minute.
    """
    times: dict[str, list[str]] = {}
    for frame, words in happened:
        times.setdefault(words, []).append(f"{period * frame:.1f} s")
    return "; ".join(f"{words} at {_listed(at)}" for words, at in times.items())


def _listed(times: Sequence[str]) -> str:
    rest = times[LISTED:]
    if len(rest) < 2:
        return ", ".join(times)
    return f"{', '.join(times[:LISTED])}, and {len(rest)} times more until {rest[-1]}"


def score_episode(task: Task, seed: int, trace: Trace, reference: Reference, ending: Ending) -> Outcome:
    """Compare an episode with the expert's on the same seed."""
    error = trajectory_error(trace.state, reference.state)
    confusion, hits = _planner_scores(trace, len(task.labels))
    departed = _departure(task, trace, reference)
    moved: Motion = motion(trace, task.observed, task.physics.control_period)
    return Outcome(
        seed=seed,
        success=ending.success,
        unmet=ending.unmet,
        frames=len(trace.action),
        ik_failures=sum(bool(failure) for failure in trace.ik_failures),
        position_error_cm=100.0 * float(error.position.mean()),
        angle_error_rad=float(error.angle.mean()),
        dtw_cm=100.0 * error.dtw,
        position_error_cm_by_primitive=_error_by_primitive(error.position, reference.scripted, task.labels),
        start=_start(task, trace),
        primitives=_played(trace.executed, task.labels),
        expert_primitives=_played(reference.scripted, task.labels),
        stage=("", *(stage.name for stage in task.stages), "success")[trace.stage[-1]],
        planner_confusion=confusion,
        planner_boundary_hits=hits,
        departed_frame=departed,
        departed_in=_primitive_at(trace, departed, task.labels),
        measures={m.name: round(float(v), 5) for m, v in zip(task.measures, trace.measures[-1], strict=True)},
        expert_success=reference.success,
        motion={name: round(float(value), 5) for name, value in vars(moved).items()},
        expert_jerk_m_s3=round(jerk(hand_poses(reference.state)[..., :3], task.physics.control_period), 5),
        stages=int(trace.stage[-1]),
        events=tuple((frame, event) for frame, event in enumerate(trace.events) if event),
        noticed=tuple((i, words) for i, told in enumerate(trace.explanations) if told for words in told.events),
        scenario=trace.scenario.to_json(),
    )


def _error_by_primitive(
    position: NDArray[np.float64], scripted: NDArray[np.int64], labels: tuple[str, ...]
) -> dict[str, float]:
    """Mean of the position error (T + 1,), m, over the frames of each primitive, in cm."""
    after = position[1:]  # row i + 1 is where the action of frame i led
    scripted = scripted[: len(after)]
    return {
        name: 100.0 * float(after[scripted == label].mean())
        for label, name in enumerate(labels)
        if (scripted == label).any()
    }


def _start(task: Task, trace: Trace) -> tuple[float, ...]:
    """x and y of every observed object before the first frame, m, to a tenth of a millimetre."""
    return tuple(round(float(value), 4) for name in task.observed for value in trace.poses[name][0, :2])


def _played(executed: NDArray[np.int64], labels: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the executed primitives in order, each run of frames once."""
    first = np.flatnonzero(np.diff(executed, prepend=-1))
    return tuple(labels[executed[frame]] for frame in first if executed[frame] >= 0)


def _primitive_at(trace: Trace, frame: int, labels: tuple[str, ...]) -> str:
    """The primitive that was played at a frame, or the expert's if the policy has none; empty for frame -1."""
    if frame < 0:
        return ""
    label = trace.executed[frame] if trace.executed[frame] >= 0 else trace.scripted[frame]
    return labels[label] if label >= 0 else ""


def _departure(task: Task, trace: Trace, reference: Reference) -> int:
    """The frame whose end is the first with a hand or an object too far from the expert's; -1 if there is none."""
    ours = _positions(trace.state, observed_poses(task, trace))
    theirs = _positions(reference.state, reference.objects)
    frames = min(len(ours), len(theirs))
    away = np.linalg.norm(ours[:frames] - theirs[:frames], axis=-1).max(1) > DEPARTURE
    return max(int(away.argmax()) - 1, 0) if away.any() else -1


def _positions(state: NDArray[np.float32], objects: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (T + 1, hands and objects, 3), m."""
    return np.concatenate([hand_poses(state), objects], axis=1)[..., :3]


def _planner_scores(trace: Trace, count: int) -> tuple[list[list[int]], list[bool]]:
    """Confusion matrix (K, K) over frames, and hits at the first frames of the expert's primitives.

    Both are empty unless every frame has the planner's probabilities of all K primitives. If they do not sum to 1, the
    planner has other primitives as well, and the most probable one of the task need not be its choice.
    """
    explanations = [explanation for explanation in trace.explanations if explanation is not None]
    sums = np.array([explanation.probabilities.sum() for explanation in explanations])
    if len(explanations) < len(trace.explanations) or (sums < MIN_PROBABILITY_SUM).any():
        return [], []
    confusion = np.zeros((count, count), np.int64)
    labelled = trace.scripted >= 0
    np.add.at(confusion, (trace.scripted[labelled], trace.predicted[labelled]), 1)
    first = np.flatnonzero((np.diff(trace.scripted, prepend=-1) != 0) & labelled)
    return confusion.tolist(), (trace.predicted[first] == trace.scripted[first]).tolist()
