"""The report of an evaluation: ``results.json``, ``report.md`` and ``report.png``."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hdril.evaluation.picture import draw
from hdril.evaluation.results import Comparison, Run, headline, summarise
from hdril.evaluation.score import DEPARTURE, Outcome, in_words
from hdril.files import naming
from hdril.markdown import table
from hdril.tasks import get_task

PICTURE = "report.png"
DTW = (
    "DTW is the mean distance along the optimal warping path P* of a hand's positions x and the expert's y, "
    "D = 1/|P*| Σ_(i,j)∈P* ‖x_i − y_j‖, mean of both hands: it forgives what is early or late, and an offset across "
    "the motion counts the same at any number of frames."
)


def write_report(
    folder: Path, run: Run, outcomes: Sequence[Outcome], comparison: Comparison | None = None
) -> dict[str, Any]:
    """Write the report into ``folder``, which exists; returns the data of ``results.json``.

    Args:
        comparison: success against another policy on the same seeds, see :func:`hdril.evaluation.results.compare`.
    """
    summary = summarise(run, outcomes, comparison)
    with naming(folder):
        (folder / "results.json").write_text(json.dumps(summary, indent=2))
        draw(folder / PICTURE, outcomes, summary)
        (folder / "report.md").write_text(markdown(summary, outcomes))
    return summary


def markdown(summary: Mapping[str, Any], outcomes: Sequence[Outcome]) -> str:
    """The text of the report."""
    failures = [outcome for outcome in outcomes if not outcome.success]
    blocks = [
        *_introduction(summary),
        *_errors(summary),
        *_jerk(summary["jerk_to_expert"]),
        *_order(summary),
        *_comparison(summary["comparison"]),
        *_planner(summary["planner"], get_task(summary["task"]).labels),
        *_events([o for o in outcomes if o.events or o.noticed], get_task(summary["task"]).physics.control_period),
        *(_failures(summary, failures) if failures else []),
    ]
    return "\n\n".join(blocks) + "\n"


def _introduction(summary: Mapping[str, Any]) -> list[str]:
    held_out = "held out" if summary["held_out"] else "not known to be held out"
    basis = f" ({summary['held_out_basis']})" if summary["held_out_basis"] else ""
    overrides = f" with `{' '.join(summary['overrides'])}`" if summary["overrides"] else ""
    return [
        f"# {summary['task']}",
        f"**{headline(summary)}**, {held_out}{basis}.",
        *summary["notes"],
        f"Policy: `{summary['policy']}`{overrides}",
        f"![Where episodes succeeded, and how far the hands were from the expert's]({PICTURE})",
    ]


def _errors(summary: Mapping[str, Any]) -> list[str]:
    """Errors against the expert, over the seeds that the expert solves."""
    count = summary["n_expert_failures"]
    left_out = f"The expert fails on {count} of {summary['n_episodes']} seeds; the errors leave them out."
    if summary["position_error_cm"] is None:
        return [f"The expert fails on all {count} seeds: there is nothing to compare the hands with."]
    by_primitive = summary["position_error_cm_by_primitive"]
    columns = (("position_error_cm", 2), ("angle_error_rad", 4), ("dtw_cm", 2))
    return [
        "Against the noise-free expert on the same seed, mean ± standard deviation over episodes:",
        table(("position, cm", "angle, rad", "DTW, cm"), [[_spread(summary[key], digits) for key, digits in columns]]),
        "Position error by the expert's primitive, cm:",
        table(list(by_primitive), [[_spread(value, 2) for value in by_primitive.values()]]),
        *([left_out] if count else []),
        DTW,
    ]


def _spread(value: Mapping[str, float], digits: int) -> str:
    return f"{value['mean']:.{digits}f} ± {value['std']:.{digits}f}"


def _jerk(ratio: float | None) -> list[str]:
    return [] if ratio is None else [f"Where both succeed, the hands' jerk is {ratio:.2f} times the expert's."]


def _order(summary: Mapping[str, Any]) -> list[str]:
    if summary["pc_expert_order"] is None:
        return []
    return [
        f"The policy began with the expert's primitive in {summary['pc_expert_choice']:.1f} % of episodes, and played "
        f"the expert's order of primitives in {summary['pc_expert_order']:.1f} %."
    ]


def _comparison(comparison: Mapping[str, Any] | None) -> list[str]:
    """Success against another policy on the same seeds."""
    if comparison is None:
        return []
    low, high = comparison["pc_difference_ci95"]
    return [
        "## Comparison",
        f"Against `{comparison['against']}` on the same seeds:",
        table(
            ("both succeeded", "this policy alone", "the other alone", "neither"),
            [[comparison[key] for key in ("both", "first_only", "second_only", "neither")]],
        ),
        f"The success rates differ by {comparison['pc_difference']:+.1f} percentage points (95 % interval {low:+.1f} to "
        f"{high:+.1f}, Newcombe's method 10); McNemar's exact test gives p = {comparison['p_value']:.3g}. This compares two "
        "trained policies. Another training of either may give another rate.",
    ]


def _planner(planner: Mapping[str, Any] | None, labels: tuple[str, ...]) -> list[str]:
    if planner is None:
        return []
    rows = zip(labels, planner["confusion"], strict=True)
    return [
        "## Planner",
        f"It prefers the expert's primitive at {planner['pc_correct']:.2f} % of frames, and at "
        f"{planner['pc_correct_at_boundaries']:.2f} % of the first frames of a primitive. Frames of the expert's primitive "
        "(row) at which it prefers each (column):",
        table(("", *labels), [[name, *(count or "" for count in row)] for name, row in rows]),
    ]


def _events(eventful: Sequence[Outcome], period: float) -> list[str]:
    """What happened to the episodes and when, and what the policy noticed."""
    if not eventful:
        return []
    rows = [
        [
            outcome.seed,
            in_words(outcome.events, period),
            in_words(outcome.noticed, period),
            "success" if outcome.success else f"failure: {outcome.unmet}",
        ]
        for outcome in eventful
    ]
    return ["## Events", table(("seed", "happened", "the policy noticed", "outcome"), rows)]


def _failures(summary: Mapping[str, Any], failures: Sequence[Outcome]) -> list[str]:
    """What went wrong, in all and seed by seed."""
    task = get_task(summary["task"])
    reasons = Counter(reason for outcome in failures for reason in outcome.unmet.split(", "))
    reached = Counter(outcome.stage or "none" for outcome in failures)
    departed = Counter(outcome.departed_in for outcome in failures if outcome.departed_in)
    stages = {name: reached[name] for name in ("none", *(stage.name for stage in task.stages)) if reached[name]}
    left = f"Where a hand or an object was first more than {100 * DEPARTURE:.0f} cm from the expert's:"
    return [
        "## Failures",
        f"Conditions of success that did not hold: {_counts(dict(reasons.most_common()))}.",
        *([f"The last stage that was reached: {_counts(stages)}."] if task.stages else []),
        *([f"{left} {_counts(dict(departed.most_common()))}."] if departed else []),
        _failure_table(failures, [measure.name for measure in task.measures]),
    ]


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} ({count})" for name, count in counts.items())


def _failure_table(failures: Sequence[Outcome], measures: Sequence[str]) -> str:
    heads = (
        "seed", "not met", "last stage", "left the expert's path in", *measures, "position error, cm",
        "frames without inverse kinematics", "expert",
    )  # fmt: skip
    rows = [
        [outcome.seed, outcome.unmet, outcome.stage or "none", outcome.departed_in,
         *(f"{outcome.measures[name]:.4g}" for name in measures), f"{outcome.position_error_cm:.2f}",
         outcome.ik_failures, "succeeds" if outcome.expert_success else "fails"]
        for outcome in failures
    ]  # fmt: skip
    return table(heads, rows)
