"""The report of a suite: ``suite.json``, ``suite.md`` and ``suite.png``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hdril.files import naming
from hdril.markdown import table

PICTURE = "suite.png"
_COLOURS = {"nominal": "black", "factor": "tab:blue", "varied": "tab:purple", "event": "tab:orange", "hard": "tab:red"}
_MOTION = (
    ("path_length_m", "path, m", 2),
    ("jerk_m_s3", "jerk, m/s³", 1),
    ("slip_m", "slip, m", 4),
    ("peak_force_n", "peak force, N", 0),
    ("peak_height_difference_m", "peak height difference, m", 3),
)


def write_suite(folder: Path, data: Mapping[str, Any]) -> None:
    """Write the report into ``folder``, which exists and holds a folder for each cell."""
    with naming(folder):
        (folder / "suite.json").write_text(json.dumps(data, indent=2))
        draw_suite(folder / PICTURE, data)
        (folder / "suite.md").write_text(suite_markdown(data))


def suite_markdown(data: Mapping[str, Any]) -> str:
    """The text of the report."""
    last = data["first_seed"] + data["num_episodes"] - 1
    held_out = "held out" if data["held_out"] else "not known to be held out"
    basis = f" ({data['held_out_basis']})" if data["held_out_basis"] else ""
    overrides = f" with `{' '.join(data['overrides'])}`" if data["overrides"] else ""
    disturbed = [row for row in data["rows"] if row["against_control"]]
    blocks = [
        f"# {data['task']}: {data['suite']}",
        f"Policy: `{data['policy']}`{overrides}",
        f"Every row is {data['num_episodes']} episodes, one for each of the seeds {data['first_seed']} to {last}, "
        f"{held_out}{basis}. A row's folder holds its own report.",
        f"![Success of each row with its 95 % interval]({PICTURE})",
        _success_table(data["rows"]),
        "Intervals are Wilson's for success, and Newcombe's method 10 for differences on the same seeds. Stages are the mean "
        "number reached; the last is success.",
        *(_pairs(disturbed, {row["cell"]: row for row in data["controls"]}) if disturbed else ()),
        "## Motion",
        "Means over all episodes, failures too, of: the length of both hands' paths; the root mean square of their jerk "
        "(third difference quotient of position); how far objects moved in the hands that held them; the largest force of the "
        "robot on one body at the end of a frame; the largest difference between the heights of the hands.",
        _motion_table(data["rows"]),
    ]
    return "\n\n".join(blocks) + "\n"


def _difference(pair: Mapping[str, Any] | None) -> str:
    if pair is None:
        return ""
    low, high = pair["pc_difference_ci95"]
    return f"{pair['pc_difference']:+.1f} ({low:+.1f} to {high:+.1f})"


def _success(row: Mapping[str, Any]) -> str:
    low, high = row["pc_success_ci95"]
    return f"{row['pc_success']:.1f} ({low:.1f} to {high:.1f})"


def _success_table(rows: list[Mapping[str, Any]]) -> str:
    heads = ("", "task", "success, % (95 % interval)", "against nominal, points", "stages", "expert fails on")
    return table(heads, [
        (f"[{row['cell']}]({row['cell']}/report.md)", f"`{row['task']}`", _success(row), _difference(row["against_nominal"]),
         f"{row['stages']:.2f} of {row['n_stages']}", row["n_expert_failures"] or "")
        for row in rows
    ])  # fmt: skip


def _pairs(rows: list[Mapping[str, Any]], controls: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What the events did."""
    heads = (
        "event", "with it, %", "control, %", "difference, points (95 % interval)", "lost", "won", "p (McNemar)",
        "p (Holm)",
    )  # fmt: skip
    counted = [(row, row["against_control"]) for row in rows]
    body = [
        (row["cell"], f"{row['pc_success']:.1f}", f"{controls[row['control']]['pc_success']:.1f}", _difference(pair),
         pair["second_only"], pair["first_only"], f"{pair['p_value']:.3g}", f"{pair['p_holm']:.3g}")
        for row, pair in counted
    ]  # fmt: skip
    return [
        "## Events",
        "The control of an episode has the same scene, noise and budget of frames, and nothing happens in it: until the event "
        "the two are the same to the last bit. Lost are seeds on which the control alone succeeded, won those on which it alone "
        "failed. The p-values of Holm's method are adjusted for all rows.",
        table(heads, body),
    ]


def _motion_table(rows: list[Mapping[str, Any]]) -> str:
    heads = ("", *(head for _, head, _ in _MOTION))
    return table(heads, [
        (row["cell"], *(f"{row['motion'][name]:.{digits}f}" for name, _, digits in _MOTION)) for row in rows
    ])  # fmt: skip


def draw_suite(path: Path, data: Mapping[str, Any]) -> None:
    """Success of each row with its interval; a ring for the control of a row with events."""
    rows = data["rows"]
    controls = {row["cell"]: row["pc_success"] for row in data["controls"]}
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 1.2 + 0.28 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for height, row in enumerate(rows):
        low, high = row["pc_success_ci95"]
        rate, colour = row["pc_success"], _COLOURS[row["kind"]]
        # At 0 and 100 % the interval ends there, but for rounding.
        axes.errorbar(
            rate, height, xerr=[[max(rate - low, 0.0)], [max(high - rate, 0.0)]], fmt="o", color=colour, capsize=3
        )
        if row["against_control"]:
            axes.plot(
                controls[row["control"]], height, "o", markersize=9, markerfacecolor="none", markeredgecolor="grey"
            )
    axes.axvline(rows[0]["pc_success"], color="grey", linewidth=0.8, linestyle=":")
    axes.set(xlim=(-3, 103), xlabel="success, % (95 % interval; ring: the same scenes without the event)")
    axes.set_yticks(range(len(rows)), [row["cell"] for row in rows])
    axes.invert_yaxis()
    axes.set_title(f"{data['task']}: {data['policy']}", fontsize=10)
    figure.savefig(path, dpi=110)
