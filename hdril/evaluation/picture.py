"""An evaluation as a picture: where episodes succeeded, and the position error of each primitive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hdril.evaluation.results import headline
from hdril.evaluation.score import Outcome
from hdril.tasks import get_task

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw(path: Path, outcomes: Sequence[Outcome], summary: Mapping[str, Any]) -> None:
    """Write the picture of an evaluation whose data are ``summary``."""
    from matplotlib.figure import Figure  # here, because each worker process imports this module

    figure = Figure(figsize=(10, 4), layout="constrained")
    area, bars = figure.subplots(1, 2)
    _draw_starts(area, outcomes, get_task(summary["task"]).observed)
    _draw_errors(bars, summary["position_error_cm_by_primitive"])
    figure.suptitle(f"{summary['task']}: {headline(summary)}", fontsize=10)
    figure.savefig(path, dpi=110)


def _draw_starts(axes: Axes, outcomes: Sequence[Outcome], names: tuple[str, ...]) -> None:
    """Start positions of the observed objects, seen from above, coloured by success."""
    starts = np.array([outcome.start for outcome in outcomes]).reshape(len(outcomes), -1, 2)
    success = np.array([outcome.success for outcome in outcomes])
    for i, name in enumerate(names):
        for chosen, colour, word in ((success, "tab:green", "success"), (~success, "tab:red", "failure")):
            if chosen.any():
                # The robot looks along +x: its left is shown on the left.
                x, y = -starts[chosen, i, 1], starts[chosen, i, 0]
                axes.scatter(x, y, s=14, c=colour, marker="os^D"[i % 4], label=f"{name}: {word}")
    axes.set(xlabel="to the right of the robot, m", ylabel="in front of the robot, m", title="Start positions")
    axes.set_aspect("equal")
    axes.legend(fontsize=8)


def _draw_errors(axes: Axes, errors: Mapping[str, Mapping[str, float]]) -> None:
    """Mean position error of each primitive, with the standard deviation over episodes."""
    means, deviations = ([spread[key] for spread in errors.values()] for key in ("mean", "std"))
    axes.bar(list(errors), means, yerr=deviations, color="tab:blue")
    axes.set(ylabel="cm from the expert's hands", title="Position error")
    axes.set_xticks(range(len(errors)), list(errors), rotation=45, ha="right", rotation_mode="anchor")
