"""The report of ``learning.py``: text and picture, from its JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from pairs import paired_p_value

from hdril.evaluation.statistics import TrainingSpread, holm
from hdril.markdown import table

Summary = Mapping[str, Any]
BASELINE = "deterministic"
"""The latent that the others are compared with."""


def markdown(found: Summary, picture: str) -> str:
    """The report as Markdown."""
    blocks = [*_introduction(found), *_minutes(found, picture), *_demonstrations(found), *_latents(found)]
    return "\n\n".join(blocks) + "\n"


def _rate(summary: Summary) -> str:
    """Success of one policy: "n of m (low to high %)"."""
    low, high = summary["pc_success_ci95"]
    return f"{summary['n_success']} of {summary['n_episodes']} ({low:.1f} to {high:.1f} %)"


def _over_trainings(runs: Sequence[Summary]) -> TrainingSpread:
    return TrainingSpread(tuple(run["n_success"] for run in runs), runs[0]["n_episodes"])


def _error(runs: Sequence[Summary]) -> str:
    """Position error, cm: the mean, and the range over trainings if there are several."""
    means = [run["position_error_cm"]["mean"] for run in runs]
    spread = f" ({min(means):.2f} to {max(means):.2f})" if len(means) > 1 else ""
    return f"{sum(means) / len(means):.2f}{spread}"


def _introduction(found: Summary) -> list[str]:
    return [
        f"# How HDR-IL learns {found['task']}",
        f"Made by `python scripts/learning.py` on commit {found['commit']}, on {found['cores']} cores and no GPU. Closed loop, "
        "planner included, held-out seeds. Intervals in parentheses are 95 % intervals (Wilson) over the seeds, for one trained "
        "policy. The position error is the distance of the hands from the expert's on the same seed, mean over episodes.",
        "Several trainings of one row are written as trainings × seeds: the mean of their success rates, then their range and "
        "standard deviation. They are evaluated on the same seeds, so that they are not pooled. All trainings have the same "
        "seed for weights and batches; choices differ in the demonstrations alone.",
    ]


def _reached(curve: Sequence[Summary], percent: float) -> Summary | None:
    """The first point from which on the rate stays at ``percent`` or above."""
    kept = (point for i, point in enumerate(curve) if all(later["pc_success"] >= percent for later in curve[i:]))
    return next(kept, None)


def _minutes(found: Summary, picture: str) -> list[str]:
    reached = _reached(found["curve"], 99.0)
    until = f"From {reached['minutes']:.1f} minutes on, 99 % or more succeed" if reached else "99 % is not reached"
    rows = [
        [point["steps"], f"{point['minutes']:.1f}", _rate(point), _error([point]), f"{point['planner_pc_correct']:.1f}"]
        for point in found["curve"]
    ]
    return [
        "## Minutes",
        f"`OMP_NUM_THREADS=1 lerobot-train --config_path=configs/train/{found['task']}.yaml` on {found['demonstrations']} "
        "demonstrations. Minutes are from the start of the command, imports included, to the checkpoint. The linear maps are "
        "solved before the first step. The first steps train the planner, and the rest train what the maps do not explain. "
        f"The seeds start at {found['seed']}. {until}, in this one training.",
        f"![Success over minutes of training]({picture})",
        table(("steps", "minutes", "success", "position error, cm", "planner right, % of frames"), rows),
        f"The last checkpoint on seeds from {found['held_out_seed']} on: **{_rate(found['final'])}**, "
        f"{_error([found['final']])} cm.",
    ]


def _demonstrations(found: Summary) -> list[str]:
    heads = ("demonstrations", *(f"choice {i}" for i in range(found["choices"])), "over choices", "position error, cm")
    rows = [
        [size, *(_rate(run) for run in runs), _over_trainings(runs), _error(runs)]
        for size, runs in found["few_shot"].items()
    ]
    return [
        "## Demonstrations",
        f"{found['few_steps']:,} steps on disjoint choices of the demonstrations (`--dataset.episodes`); the same seeds.",
        table(heads, rows),
    ]


def _latents(found: Summary) -> list[str]:
    small = found["few"][0]
    rows = [
        [name, _rate(runs["all"]), _error([runs["all"]]), _over_trainings(runs["few"]), _error(runs["few"])]
        for name, runs in found["latent"].items()
    ]
    return [
        "## The latent",
        f"With all demonstrations ({found['steps']:,} steps, one training) and with {small} ({found['few_steps']:,} steps, "
        f"{found['choices']} choices), on seeds from {found['latent_seed']} on, which nothing else here uses.",
        table(("latent", "all: success", "position error, cm", f"{small}: success", "position error, cm"), rows),
        *_latent_tests(found, small),
    ]


def _latent_tests(found: Summary, small: int) -> list[str]:
    """Each variational latent against the deterministic one, training by training."""
    conditions = [f"choice {i}" for i in range(found["choices"])]
    base = found["latent"][BASELINE]["few"]
    others = {name: runs["few"] for name, runs in found["latent"].items() if name != BASELINE}
    pairs = [pair for runs in others.values() for pair in zip(runs, base, strict=True)]
    p_values = [paired_p_value(*pair) for pair in pairs]
    texts = [p.text(adjusted) for p, adjusted in zip(p_values, holm([p.value for p in p_values]), strict=True)]
    rows = []
    for i, (name, runs) in enumerate(others.items()):
        row = zip(runs, base, texts[i * len(base) : (i + 1) * len(base)], strict=True)
        rows.append([name, *(f"{run['n_success']} against {ours['n_success']}, {text}" for run, ours, text in row)])
    bound = (
        " Where the JSON has no outcomes by seed, p is the largest that the two numbers of successes allow (≤)."
        if any(not p.exact for p in p_values)
        else ""
    )
    return [
        f"Each against `{BASELINE}`, trained on the same {small} demonstrations, on the same seeds: successes, and p of "
        f"McNemar's exact test, adjusted by Holm's method for the {len(p_values)} tests of the table.{bound}",
        table(("latent", *conditions), rows),
        f"Such a test tells two trained policies apart, not two latents: for that, the trainings are the sample, and there are "
        f"{found['choices']} pairs of them.",
    ]


def draw(found: Summary, path: Path) -> None:
    """Success with its interval, and the position error, over minutes."""
    curve = found["curve"]
    minutes = [point["minutes"] for point in curve]
    figure, (success, error) = plt.subplots(1, 2, figsize=(9, 3), constrained_layout=True)
    lowest = min(point["pc_success_ci95"][0] for point in curve)
    success.fill_between(minutes, *zip(*(point["pc_success_ci95"] for point in curve), strict=True), alpha=0.25)
    success.plot(minutes, [point["pc_success"] for point in curve], marker="o")
    success.axhline(99.0, color="grey", linewidth=0.8, linestyle="--")
    success.set(xlabel="minutes of training", ylabel="success, %", ylim=(max(lowest - 2.0, 0.0), 101), xlim=(0, None))
    error.plot(minutes, [point["position_error_cm"]["mean"] for point in curve], marker="o")
    error.set(xlabel="minutes of training", ylabel="position error, cm", ylim=(0, None), xlim=(0, None))
    figure.savefig(path, dpi=110)
    plt.close(figure)
