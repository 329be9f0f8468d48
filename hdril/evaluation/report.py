"""An evaluation as numbers (JSON), as text (Markdown) and as a picture."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from hdril import __version__
from hdril.evaluation.score import DEPARTURE, Outcome
from hdril.evaluation.statistics import wilson_interval
from hdril.tasks import get_task

PICTURE = "report.png"


@dataclass(frozen=True)
class Run:
    """What was evaluated: for the report, and to tell whether an interrupted run is the same."""

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
    """Frames after which an episode was cut; 0: the task's horizon."""
    notes: tuple[str, ...] = ()
    """Sentences that a reader of the results must know."""
    identity: dict[str, Any] = field(default_factory=dict)
    """What made the results, see :class:`hdril.evaluation.identity.Identity`."""


def summarise(run: Run, outcomes: list[Outcome]) -> dict[str, Any]:
    """Everything of the report as plain data. Rates are in percent, as LeRobot has them."""
    successes = sum(outcome.success for outcome in outcomes)
    low, high = wilson_interval(successes, len(outcomes))

    def spread(values: list[float]) -> dict[str, float]:
        return {"mean": float(np.mean(values)), "std": float(np.std(values))}

    labels = get_task(run.task).labels
    script = tuple(primitive.name for primitive in get_task(run.task).primitives)
    planned = [outcome for outcome in outcomes if outcome.primitives]
    return {
        **asdict(run),
        "n_episodes": len(outcomes),
        "n_success": successes,
        "pc_success": 100.0 * successes / len(outcomes),
        "pc_success_ci95": [100.0 * low, 100.0 * high],
        "position_error_cm": spread([outcome.position_error_cm for outcome in outcomes]),
        "angle_error_rad": spread([outcome.angle_error_rad for outcome in outcomes]),
        "dtw_cm": spread([outcome.dtw_cm for outcome in outcomes]),
        "position_error_cm_by_primitive": {
            name: spread(
                [o.position_error_cm_by_primitive[name] for o in outcomes if name in o.position_error_cm_by_primitive]
            )
            for name in labels
        },
        "stages_reached": dict(Counter(o.stage or "none" for o in outcomes)),
        "pc_expert_order": 100.0 * sum(o.primitives == script for o in planned) / len(planned) if planned else None,
        "planner": _planner(outcomes),
        "hdril_version": __version__,
        "per_episode": [asdict(outcome) for outcome in outcomes],
    }


def _planner(outcomes: list[Outcome]) -> dict[str, Any] | None:
    """Accuracy of the planner, percent, and its confusion matrix over frames; None for a policy without one."""
    judged = [outcome for outcome in outcomes if outcome.planner_confusion]
    if not judged:
        return None
    confusion = np.sum([outcome.planner_confusion for outcome in judged], axis=0)
    hits = [hit for outcome in judged for hit in outcome.planner_boundary_hits]
    return {
        "pc_correct": 100.0 * float(np.trace(confusion) / confusion.sum()),
        "pc_correct_at_boundaries": 100.0 * float(np.mean(hits)),
        "confusion": confusion.tolist(),
    }


def write_report(folder: Path, run: Run, outcomes: list[Outcome]) -> dict[str, Any]:
    """Write ``results.json``, ``report.md`` and the picture into ``folder``; returns the data of the first."""
    summary = summarise(run, outcomes)
    (folder / "results.json").write_text(json.dumps(summary, indent=2))
    _draw(folder / PICTURE, run, outcomes, summary)
    (folder / "report.md").write_text(_markdown(run, outcomes, summary))
    return summary


def headline(summary: dict[str, Any]) -> str:
    """One line: the rate, its interval, n and the seeds."""
    low, high = summary["pc_success_ci95"]
    last = summary["first_seed"] + summary["n_episodes"] - 1
    budget = f", {summary['max_frames']} frames at most" if summary.get("max_frames") else ""
    return (
        f"{summary['n_success']} of {summary['n_episodes']} succeeded: {summary['pc_success']:.1f} % "
        f"(95 % interval {low:.1f} to {high:.1f}), seeds {summary['first_seed']} to {last}{budget}"
    )


def _markdown(run: Run, outcomes: list[Outcome], summary: dict[str, Any]) -> str:
    held_out = "held out" if run.held_out else "not known to be held out"
    basis = f" ({run.held_out_basis})" if run.held_out_basis else ""

    def spread(key: str, digits: int) -> str:
        return f"{summary[key]['mean']:.{digits}f} ± {summary[key]['std']:.{digits}f}"

    lines = [
        f"# {run.task}",
        "",
        f"**{headline(summary)}**, {held_out}{basis}.",
        "",
        *(line for note in run.notes for line in (note, "")),
        f"Policy: `{run.policy}`" + (f" with `{' '.join(run.overrides)}`" if run.overrides else ""),
        "",
        f"![Where episodes succeeded, and how far the hands were from the expert's]({PICTURE})",
        "",
        "Against the noise-free expert on the same seed, mean ± standard deviation over episodes:",
        "",
        "| position, cm | angle, rad | DTW, cm a frame |",
        "|---|---|---|",
        f"| {spread('position_error_cm', 2)} | {spread('angle_error_rad', 4)} | {spread('dtw_cm', 2)} |",
        "",
        "| " + " | ".join(summary["position_error_cm_by_primitive"]) + " |",
        "|" + "---|" * len(summary["position_error_cm_by_primitive"]),
        "| "
        + " | ".join(f"{v['mean']:.2f} ± {v['std']:.2f} cm" for v in summary["position_error_cm_by_primitive"].values())
        + " |",
        "",
    ]
    if summary["pc_expert_order"] is not None:
        lines += [
            f"The planner chose the expert's order of primitives in {summary['pc_expert_order']:.1f} % of episodes.",
            "",
        ]
    if planner := summary["planner"]:
        lines += [
            "## Planner",
            "",
            f"It prefers the expert's primitive at {planner['pc_correct']:.2f} % of frames, and at "
            f"{planner['pc_correct_at_boundaries']:.2f} % of the first frames of a primitive. Frames of the expert's primitive "
            "(row) at which it prefers each (column):",
            "",
        ]
        labels = list(summary["position_error_cm_by_primitive"])
        lines += ["| | " + " | ".join(labels) + " |", "|" + "---|" * (len(labels) + 1)]
        lines += [
            f"| {name} | " + " | ".join(str(count) if count else "" for count in row) + " |"
            for name, row in zip(labels, planner["confusion"], strict=True)
        ]
        lines += [""]
    failures = [outcome for outcome in outcomes if not outcome.success]
    if failures:
        reasons = Counter(reason for outcome in failures for reason in outcome.unmet.split(", "))
        lines += [
            "## Failures",
            "",
            "What did not hold: " + ", ".join(f"{reason} ({n})" for reason, n in reasons.most_common()) + ".",
            "",
        ]
        if stages := get_task(run.task).stages:
            reached = Counter(outcome.stage or "none" for outcome in failures)
            order = ("none", *(stage.name for stage in stages))
            counts = ", ".join(f"{name} ({reached[name]})" for name in order if reached[name])
            lines += [f"How far they came: {counts}.", ""]
        measures = [measure.name for measure in get_task(run.task).measures]
        if left := Counter(outcome.departed_in for outcome in failures if outcome.departed_in):
            lines += [
                f"Where a hand or an object was first more than {100 * DEPARTURE:.0f} cm from the expert's: "
                + ", ".join(f"{name} ({n})" for name, n in left.most_common()) + ".",
                "",
            ]  # fmt: skip
        heads = [
            "seed",
            "not met",
            "last stage",
            "left the expert's path in",
            *measures,
            "position error, cm",
            "frames without inverse kinematics",
        ]
        lines += ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
        for o in failures:
            values = [f"{o.measures[name]:.4g}" for name in measures]
            row = [
                str(o.seed),
                o.unmet,
                o.stage or "none",
                o.departed_in,
                *values,
                f"{o.position_error_cm:.2f}",
                str(o.ik_failures),
            ]
            lines.append("| " + " | ".join(row) + " |")
        lines += [""]
    return "\n".join(lines)


def _draw(path: Path, run: Run, outcomes: list[Outcome], summary: dict[str, Any]) -> None:
    figure, (area, bars) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    starts = np.array([outcome.start for outcome in outcomes]).reshape(len(outcomes), -1, 2)
    success = np.array([outcome.success for outcome in outcomes])
    for i, name in enumerate(get_task(run.task).observed):
        marker = "os^D"[i % 4]
        for chosen, colour, word in ((success, "tab:green", "success"), (~success, "tab:red", "failure")):
            if chosen.any():
                # The robot looks along +x: show its left on the left.
                area.scatter(
                    -starts[chosen, i, 1], starts[chosen, i, 0], s=14, c=colour, marker=marker, label=f"{name}: {word}"
                )
    area.set(xlabel="to the right of the robot, m", ylabel="in front of the robot, m", title="Start positions")
    area.set_aspect("equal")
    area.legend(fontsize=8)
    errors = summary["position_error_cm_by_primitive"]
    bars.bar(
        list(errors), [v["mean"] for v in errors.values()], yerr=[v["std"] for v in errors.values()], color="tab:blue"
    )
    bars.set(ylabel="cm from the expert's hands", title="Position error")
    bars.set_xticks(range(len(errors)), list(errors), rotation=45, ha="right", rotation_mode="anchor")
    figure.suptitle(f"{run.task}: {headline(summary)}", fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)
