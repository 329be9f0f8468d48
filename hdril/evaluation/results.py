"""An evaluation as plain data: ``results.json``.

Rates are in percent, as in LeRobot's ``eval_info.json``. ``null`` stands for what does not apply or is not known. A *spread*
is ``{"mean": …, "std": …}`` over episodes; the standard deviation has n in its denominator.

====================================  =================================================================================
key                                   meaning
====================================  =================================================================================
``task``                              the task with its parameters, as given
``policy``                            the checkpoint, as given; for display
``policy_folder``                     where its files were, links followed, to find it from any folder; empty once published
``overrides``                         options of the policy's config that were given, ``--name=value``
``first_seed``, ``num_episodes``      the seeds are ``first_seed``, ``first_seed + 1``, …; one episode each
``held_out``                          whether the seeds were checked to be apart from the training data; null: cannot be told
``held_out_basis``                    what it was checked against, or why it cannot be told
``max_frames``                        frames after which an episode was cut; 0: the task's budget
``notes``                             sentences that a reader of the results must know
``identity``                          what made the results, see :class:`hdril.evaluation.identity.Identity`
``n_episodes``, ``n_success``         episodes played, and those that succeeded
``pc_success``                        success rate, %
``pc_success_ci95``                   its 95 % interval (Wilson), %: ``[low, high]``
``n_expert_failures``                 seeds on which the expert itself fails; the errors below leave them out
``position_error_cm``                 spread of :attr:`Outcome.position_error_cm`, cm; null if the expert solves no seed
``angle_error_rad``                   spread of :attr:`Outcome.angle_error_rad`, rad; null likewise
``dtw_cm``                            spread of :attr:`Outcome.dtw_cm`, cm; null likewise
``position_error_cm_by_primitive``    spread by name of the expert's primitive, cm; without primitives that were not reached
``motion``                            spread of each number of :class:`hdril.evaluation.motion.Motion`, by name
``jerk_to_expert``                    root mean square of the hands' jerk, over the expert's: the ratio of the means over the
                                      seeds on which both succeed; null if there are none
``stages_reached``                    episodes by the last stage reached: a stage, ``none`` or ``success``
``pc_expert_order``                   episodes in which the policy played the primitives that the expert plays in this scene, in
                                      its order, % of those with primitives; null for a policy without
``pc_expert_choice``                  the same of the first primitive alone, which is where the plan depends on the scene
``planner``                           null for a policy without a planner, or with primitives that are not the task's
``planner.pc_correct``                frames at which it prefers the expert's primitive, %
``planner.pc_correct_at_boundaries``  the same of the first frames of primitives alone, %
``planner.confusion``                 frames by the expert's primitive (row) and the preferred one (column), in the order of the
                                      task's labels
``comparison``                        against another policy on the same seeds; null if there is none
``comparison.against``                the other policy, as given; for display
``comparison.against_identity``       what it was, see :class:`hdril.evaluation.identity.PolicyIdentity`
``comparison.both``                   seeds on which both policies succeeded
``comparison.first_only``             seeds on which this policy alone succeeded
``comparison.second_only``            seeds on which the other policy alone succeeded
``comparison.neither``                seeds on which neither succeeded
``comparison.pc_difference``          success rate of this policy minus the other's, percentage points
``comparison.pc_difference_ci95``     its 95 % interval (Newcombe's method 10), percentage points
``comparison.p_value``                McNemar's exact test, two-sided
``hdril_version``                     version of hdril
``per_episode``                       an object for each seed with the fields of :class:`hdril.evaluation.score.Outcome`
====================================  =================================================================================
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from hdril import __version__
from hdril.evaluation.score import Outcome
from hdril.evaluation.statistics import (
    PairedCounts,
    mcnemar_exact,
    paired_counts,
    paired_difference_interval,
    wilson_interval,
)
from hdril.tasks import get_task


@dataclass(frozen=True)
class Run:
    """What was evaluated, for readers of the report. Whether two evaluations are of the same is told by ``identity`` alone."""

    task: str
    policy: str
    overrides: tuple[str, ...]
    first_seed: int
    num_episodes: int
    held_out: bool | None
    """True: the seeds were checked to be apart from the training data. None: that cannot be told."""
    held_out_basis: str = ""
    """What it was checked against, or why it cannot be told: a phrase for reports and cards."""
    max_frames: int = 0
    """Frames after which an episode was cut; 0: the task's budget (:attr:`hdril.tasks.Task.budget`)."""
    notes: tuple[str, ...] = ()
    """Sentences that a reader of the results must know."""
    identity: dict[str, Any] = field(default_factory=dict)
    """What made the results, see :class:`hdril.evaluation.identity.Identity`."""
    policy_folder: str = ""
    """Where the files of the policy are on this machine; empty if that is not known."""


@dataclass(frozen=True)
class Comparison:
    """Success of a policy and of another on the same seeds."""

    against: str
    """The other policy, as reports name it."""
    counts: PairedCounts
    """The first is the policy of the report."""
    against_identity: dict[str, Any] = field(default_factory=dict)
    """What the other policy was, see :class:`hdril.evaluation.identity.PolicyIdentity`."""


def compare(against: str, outcomes: Iterable[Outcome], other: Mapping[str, Any]) -> Comparison:
    """Pair outcomes with those of another evaluation, given as the data of its ``results.json``.

    Raises:
        ValueError: the seeds are not the same.
    """
    ours = {outcome.seed: outcome.success for outcome in outcomes}
    theirs = {int(episode["seed"]): bool(episode["success"]) for episode in other["per_episode"]}
    return Comparison(against, paired_counts(ours, theirs), other["identity"].get("policy", {}))


def summarise(run: Run, outcomes: Sequence[Outcome], comparison: Comparison | None = None) -> dict[str, Any]:
    """The data of ``results.json``.

    Raises:
        ValueError: there are no outcomes.
    """
    successes = sum(outcome.success for outcome in outcomes)
    low, high = wilson_interval(successes, len(outcomes))
    compared = [outcome for outcome in outcomes if outcome.expert_success]
    return {
        **asdict(run),
        "n_episodes": len(outcomes),
        "n_success": successes,
        "pc_success": 100.0 * successes / len(outcomes),
        "pc_success_ci95": [100.0 * low, 100.0 * high],
        "n_expert_failures": len(outcomes) - len(compared),
        "position_error_cm": _spread([outcome.position_error_cm for outcome in compared]),
        "angle_error_rad": _spread([outcome.angle_error_rad for outcome in compared]),
        "dtw_cm": _spread([outcome.dtw_cm for outcome in compared]),
        "position_error_cm_by_primitive": _by_primitive(compared, get_task(run.task).labels),
        "motion": {name: _spread([outcome.motion[name] for outcome in outcomes]) for name in outcomes[0].motion},
        "jerk_to_expert": _jerk_to_expert(outcomes),
        "stages_reached": dict(Counter(outcome.stage or "none" for outcome in outcomes)),
        "pc_expert_order": _as_the_expert(outcomes),
        "pc_expert_choice": _as_the_expert(outcomes, first=1),
        "planner": _planner(outcomes),
        "comparison": _compared(comparison) if comparison else None,
        "hdril_version": __version__,
        "per_episode": [asdict(outcome) for outcome in outcomes],
    }


def headline(summary: Mapping[str, Any]) -> str:
    """One line: the rate, its interval, n and the seeds."""
    low, high = summary["pc_success_ci95"]
    last = summary["first_seed"] + summary["n_episodes"] - 1
    budget = f", {summary['max_frames']} frames at most" if summary.get("max_frames") else ""
    return (
        f"{summary['n_success']} of {summary['n_episodes']} succeeded: {summary['pc_success']:.1f} % "
        f"(95 % interval {low:.1f} to {high:.1f}), seeds {summary['first_seed']} to {last}{budget}"
    )


def _spread(values: Sequence[float]) -> dict[str, float] | None:
    return {"mean": float(np.mean(values)), "std": float(np.std(values))} if values else None


def _by_primitive(outcomes: Sequence[Outcome], labels: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Spread of the position error over each primitive that was reached."""
    errors = [outcome.position_error_cm_by_primitive for outcome in outcomes]
    spreads = {name: _spread([error[name] for error in errors if name in error]) for name in labels}
    return {name: spread for name, spread in spreads.items() if spread is not None}


def _jerk_to_expert(outcomes: Sequence[Outcome]) -> float | None:
    both = [
        (outcome.motion["jerk_m_s3"], outcome.expert_jerk_m_s3)
        for outcome in outcomes
        if outcome.success and outcome.expert_success and outcome.expert_jerk_m_s3
    ]
    return sum(ours for ours, _ in both) / sum(theirs for _, theirs in both) if both else None


def _as_the_expert(outcomes: Sequence[Outcome], first: int | None = None) -> float | None:
    """Percentage of episodes in which a policy with primitives played what the expert plays in the scene, or the ``first`` of it;
    None without such a policy."""
    planned = [outcome for outcome in outcomes if outcome.primitives]
    same = [outcome.primitives[:first] == outcome.expert_primitives[:first] for outcome in planned]
    return 100.0 * float(np.mean(same)) if planned else None


def _planner(outcomes: Sequence[Outcome]) -> dict[str, Any] | None:
    """Accuracy of the planner, %, and its confusion matrix over frames; None unless every episode has it."""
    if not all(outcome.planner_confusion for outcome in outcomes):
        return None
    confusion = np.sum([outcome.planner_confusion for outcome in outcomes], axis=0)
    hits = [hit for outcome in outcomes for hit in outcome.planner_boundary_hits]
    return {
        "pc_correct": 100.0 * float(np.trace(confusion) / confusion.sum()),
        "pc_correct_at_boundaries": 100.0 * float(np.mean(hits)),
        "confusion": confusion.tolist(),
    }


def _compared(comparison: Comparison) -> dict[str, Any]:
    low, high = paired_difference_interval(comparison.counts)
    return {
        "against": comparison.against,
        "against_identity": comparison.against_identity,
        **asdict(comparison.counts),
        "pc_difference": 100.0 * comparison.counts.difference,
        "pc_difference_ci95": [100.0 * low, 100.0 * high],
        "p_value": mcnemar_exact(comparison.counts),
    }
