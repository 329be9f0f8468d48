"""How one episode went."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hdril.evaluation.metrics import trajectory_error
from hdril.evaluation.reference import Reference
from hdril.rollout import Ending
from hdril.simulation.actions import hand_poses
from hdril.tasks import Task
from hdril.trace import Trace

DEPARTURE = 0.02
"""m from the expert's path at which an episode counts as having left it: none of 100 successes of `make demo` did."""


@dataclass(frozen=True)
class Outcome:
    """How one episode went. Errors are against the noise-free expert on the same seed: cm, rad, cm."""

    seed: int
    success: bool
    unmet: str
    frames: int
    ik_failures: int
    position_error_cm: float
    angle_error_rad: float
    dtw_cm: float
    position_error_cm_by_primitive: dict[str, float]
    start: tuple[float, ...]
    """x and y of every observed object at the start, m."""
    primitives: tuple[str, ...] = ()
    """What the policy played, in order; empty if it has no primitives."""
    stage: str = ""
    """The last of the task's stages that was reached; empty if none was."""
    measures: dict[str, float] = field(default_factory=dict)
    """The task's measures at the end."""
    planner_confusion: list[list[int]] = field(default_factory=list)
    """Frames of the expert's primitive (row) at which the planner preferred each (column); empty without a planner."""
    planner_boundary_hits: list[bool] = field(default_factory=list)
    """For each primitive of the expert, whether the planner preferred it at its first frame."""
    departed_frame: int = -1
    """First frame at whose end a hand or an object is more than :data:`DEPARTURE` from where the expert has it; -1: none."""
    departed_in: str = ""
    """The primitive that was played then (the expert's, if the policy has none)."""
    expert_success: bool = True
    """Whether the expert solves the scene of this seed. If not, the errors above say nothing about the policy."""
    expert_success: bool = True
    """Whether the expert succeeds on this seed. Where it does not, the errors compare with a failed episode."""


def score_episode(task: Task, seed: int, trace: Trace, reference: Reference, ending: Ending) -> Outcome:
    """Compare an episode with the expert's."""
    error = trajectory_error(trace.state, reference.state)
    names = np.array(task.labels)
    # Row i + 1 is where the action of frame i led.
    labels = reference.scripted[: len(error.position) - 1]
    by_primitive = {
        str(name): 100.0 * float(error.position[1:][labels == k].mean())
        for k, name in enumerate(names)
        if (labels == k).any()
    }
    executed = trace.executed
    changes = np.flatnonzero(np.diff(executed, prepend=-2))
    played = tuple(str(names[executed[i]]) for i in changes if 0 <= executed[i] < len(names))
    start = trace.environment_state[0].reshape(-1, 7)[:, :2]
    confusion, hits = _planner_scores(trace, len(names))
    departed = _departure(trace, reference)
    doing = -1 if departed < 0 else executed[departed] if executed[departed] >= 0 else trace.scripted[departed]
    return Outcome(
        seed=seed,
        success=ending.success,
        unmet=ending.unmet,
        frames=len(trace.action),
        ik_failures=sum(bool(failure) for failure in trace.ik_failures),
        position_error_cm=100.0 * float(error.position.mean()),
        angle_error_rad=float(error.angle.mean()),
        dtw_cm=100.0 * error.dtw,
        position_error_cm_by_primitive=by_primitive,
        start=tuple(round(float(v), 4) for v in start.ravel()),
        primitives=played,
        stage=("", *(stage.name for stage in task.stages), "success")[trace.stage[-1]],
        planner_confusion=confusion,
        planner_boundary_hits=hits,
        departed_frame=departed,
        departed_in=str(names[doing]) if doing >= 0 else "",
        measures={m.name: round(float(v), 5) for m, v in zip(task.measures, trace.measures[-1], strict=True)},
        expert_success=reference.success,
    )


def _departure(trace: Trace, reference: Reference) -> int:
    """The frame whose end is the first with a hand or an object too far from the expert's; -1 if there is none."""

    def positions(episode: Trace | Reference) -> NDArray[np.float64]:
        objects = episode.environment_state.reshape(len(episode.state), -1, 7).astype(np.float64)
        return np.concatenate([hand_poses(episode.state), objects], axis=1)[..., :3]

    ours, theirs = positions(trace), positions(reference)
    frames = min(len(ours), len(theirs))
    away = np.linalg.norm(ours[:frames] - theirs[:frames], axis=-1).max(1) > DEPARTURE
    return max(int(away.argmax()) - 1, 0) if away.any() else -1


def _planner_scores(trace: Trace, count: int) -> tuple[list[list[int]], list[bool]]:
    """Confusion matrix (K, K) over frames, and hits at the first frames of the expert's primitives."""
    if any(explanation is None for explanation in trace.explanations):
        return [], []
    preferred = trace.predicted
    confusion = np.zeros((count, count), np.int64)
    scripted = trace.scripted
    np.add.at(confusion, (scripted[scripted >= 0], preferred[scripted >= 0]), 1)
    first = np.flatnonzero(np.diff(scripted, prepend=-1))
    return confusion.tolist(), [bool(preferred[i] == scripted[i]) for i in first if scripted[i] >= 0]
