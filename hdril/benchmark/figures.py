"""The figures of a benchmark: success with its interval, and success over demonstrations and over minutes of training, and
what was learned from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442")
"""Okabe and Ito's colours, which people with any kind of colour blindness can tell apart (jfly.uni-koeln.de/color)."""
MARKERS = "osD^v<>P"
"""A shape for each colour: no figure needs colour to be read."""

FIGURES = ("success", "demonstrations", "minutes", "trajectories", "episode", "attention")
"""Names of all that a table may have."""


def figures(table: Mapping[str, Any]) -> dict[str, Figure]:
    """The figures of a table of ``benchmark.json``, by what they show: ``success``, where there are rows to compare;
    ``demonstrations`` and ``minutes``, where there are rows of more than one number of demonstrations, or of more than one budget
    of training; ``trajectories`` of demonstrations, a held-out ``episode`` and the ``attention`` at its beginning, where the
    table has them."""
    found = {"success": _success(table)} if len(table["rows"]) > 1 else {}
    if len({row["demonstrations"] for row in table["rows"]}) > 1:
        found["demonstrations"] = _curves(table, "demonstrations", "demonstrations", _counts)
    if len({row["minutes"] for row in table["rows"]} - {None}) > 1:
        found["minutes"] = _curves(table, "minutes", "minutes of training", lambda row: row["training_minutes"])
    if any(table["trajectories"].values()):
        found["trajectories"] = _trajectories(table["trajectories"])
    if table["episodes"]:
        found["episode"] = _episode(table["episodes"])
        attending = {name: each["attention"] for name, each in table["episodes"].items() if each["attention"]}
        if attending:
            found["attention"] = _attention(attending)
    return found


def _attention(attending: Mapping[str, Mapping[str, Any]]) -> Figure:
    """A panel for each evaluation, who attends to whom in the first frame, and last a graph whose nodes attend to all alike."""
    from matplotlib.figure import Figure

    nodes = max((told["nodes"] for told in attending.values()), key=len)
    count = len(nodes)
    panels = [(f"{name}\n{told.get('of', 'dynamics')}, {told['primitive']}", told) for name, told in attending.items()]
    panels.append(("uniform attention", {"nodes": nodes, "weights": [[1.0 / count] * count] * count}))
    figure = Figure(figsize=(1.5 + (1.8 + 0.16 * count) * len(panels), 1.9 + 0.16 * count), layout="constrained")
    for axes, (title, told) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        axes.imshow(told["weights"], cmap="cividis", vmin=0.0, vmax=1.0)
        few = len(told["nodes"]) <= 8
        size = 8 if few else 4
        axes.set_xticks(range(len(told["nodes"])), told["nodes"], rotation=90, fontsize=size)
        axes.set_yticks(range(len(told["nodes"])), told["nodes"], fontsize=size)
        axes.set_title(title, fontsize=8)
        axes.set(xlabel="gives", ylabel="takes")
        for row, values in enumerate(told["weights"] if few else []):
            for column, value in enumerate(values):
                shade = "black" if value > 0.6 else "white"
                axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7, color=shade)
    figure.colorbar(figure.axes[0].images[0], ax=figure.axes, label="share of attention", shrink=0.7)
    return figure


def _episode(episodes: Mapping[str, Mapping[str, Any]]) -> Figure:
    """A column for each evaluation, a panel for each hand: its coordinates as predicted, and as the expert has them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.2 + 3.6 * len(episodes), 4.4), layout="constrained")
    panels = figure.subplots(2, len(episodes), squeeze=False, sharex="col", sharey=True)
    for column, (name, episode) in zip(panels.T, episodes.items(), strict=True):
        for panel, side in zip(column, episode["true"], strict=True):
            for i, axis in enumerate("xyz"):
                predicted, true = ([place[i] for place in episode[key][side]] for key in ("predicted", "true"))
                panel.plot(true, color="0.6", linewidth=3.0, label="the expert" if i == 0 else None)
                panel.plot(predicted, color=COLOURS[i], marker=MARKERS[i], markevery=8, markersize=3.5, linewidth=1.2,
                           label=f"{axis}, predicted")  # fmt: skip
            panel.set_ylabel(f"{side} hand, m")
            panel.grid(alpha=0.3)
        ended = "success" if episode["success"] else "failure"
        column[0].set_title(f"{name}, seed {episode['seed']}: {ended}\n{episode['title']}", fontsize=8)
        column[-1].set_xlabel("frame")
    panels[0, -1].legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _trajectories(recorded: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """A panel for each data set: where the hands go in each demonstration, m, and one of them highlighted."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(0.4 + 4.2 * len(recorded), 3.8), layout="constrained")
    for number, (name, episodes) in enumerate(recorded.items(), 1):
        axes: Any = figure.add_subplot(1, len(recorded), number, projection="3d")
        chosen = len(episodes) // 2
        for i, episode in enumerate(episodes):
            for colour, marker, (side, places) in zip(COLOURS, MARKERS, episode.items(), strict=False):
                path = tuple(zip(*places, strict=True))
                if i != chosen:
                    axes.plot(*path, color=colour, linewidth=0.6, alpha=0.5)
                    continue
                label = f"{side} hand"
                axes.plot(*path, color=colour, linewidth=2.2, marker=marker, markevery=[0], zorder=10, label=label)
        axes.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
        axes.locator_params(nbins=4)
        axes.locator_params(axis="z", nbins=2)
        axes.set_title(f"{len(episodes)} of {name}; highlighted: {chosen}", fontsize=9)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7)
    figure.axes[-1].legend(fontsize=8, frameon=False, loc="upper left")
    return figure


def _counts(row: Mapping[str, Any]) -> list[int]:
    """Demonstrations of each training of a row."""
    return [row["demonstrations"]] * len(row["training_minutes"])


def _name(row: Mapping[str, Any], *, without: str = "") -> str:
    """What tells a row from others of its table, but for one of its numbers."""
    counted = row["data"] if without == "demonstrations" else f"{row['demonstrations']} of {row['data']}"
    minutes = "" if without == "minutes" or row["minutes"] is None else f", {row['minutes']:g} min"
    return f"{row['policy']}{minutes}, {counted}"


def _success(table: Mapping[str, Any]) -> Figure:
    """A line for each row, with a mark for each evaluation and training, and its interval over seeds."""
    from matplotlib.figure import Figure

    rows, names = table["rows"], list(table["evaluations"])
    figure = Figure(figsize=(7.5, 1.3 + 0.22 * (len(rows) + 1) * len(names)), layout="constrained")
    axes = figure.subplots()
    labels = []
    for place, row in enumerate(rows):
        labels.append(_name(row))
        for number, name in enumerate(names):
            y = place + (number - (len(names) - 1) / 2) * 0.8 / len(names)
            _mark(axes, row["cells"][name], y, number, name if place == 0 else None)
    axes.set_yticks(range(len(rows)), labels)
    # The first row on top, and room beside the outermost marks.
    axes.set(xlim=(-2, 102), ylim=(len(rows) - 0.5, -0.5), xlabel="success, %", title=table["title"])
    axes.grid(axis="x", alpha=0.3)
    # Below: beside the axes, long names of evaluations would leave them no width.
    figure.legend(loc="outside lower center", frameon=False)
    return figure


def _mark(axes: Axes, runs: Sequence[Mapping[str, Any]], y: float, number: int, label: str | None) -> None:
    """A mark with its interval for each training, close to one another."""
    colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
    for i, run in enumerate(runs):
        at = y + 0.08 * (i - (len(runs) - 1) / 2)
        axes.plot(run["pc_success_ci95"], [at, at], color=colour, linewidth=1.0)
        axes.plot([run["pc_success"]], [at], marker, color=colour, markersize=4.0, label=label if i == 0 else None)


def _curves(
    table: Mapping[str, Any], key: str, label: str, places: Callable[[Mapping[str, Any]], Sequence[float]]
) -> Figure:
    """A panel for each evaluation, a curve for each policy: the mean over trainings, and a mark for each training.

    Args:
        key: the number by which the rows of a curve differ.
        label: of the axis.
        places: where on it the trainings of a row are.
    """
    from matplotlib.figure import Figure

    names = list(table["evaluations"])
    curves: dict[str, list[Mapping[str, Any]]] = {}
    for row in sorted(table["rows"], key=lambda row: row[key] or 0.0):
        curves.setdefault(_name(row, without=key), []).append(row)
    order = dict.fromkeys(_name(row, without=key) for row in table["rows"])
    legend = 0.5 + 0.07 * max(map(len, order))  # inches beside the panels, at 8 points a letter
    figure = Figure(figsize=(0.6 + 3.2 * len(names) + legend, 3.2), layout="constrained")
    panels = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for panel, name in zip(panels, names, strict=True):
        for number, curve in enumerate(order):
            at = [places(row) for row in curves[curve]]
            rates = [[run["pc_success"] for run in row["cells"][name]] for row in curves[curve]]
            colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
            means = [sum(each) / len(each) for each in rates]
            centres = [sum(each) / len(each) for each in at]
            panel.plot(centres, means, color=colour, marker=marker, markersize=4.5, label=curve)
            for place, each in zip(at, rates, strict=True):
                panel.plot(place, each, marker, color=colour, markersize=2.5, alpha=0.6)
        panel.set(xscale="log", xlabel=label, title=name, ylim=(-2, 102))
        panel.set_xticks(sorted({row[key] for row in table["rows"] if row[key]}))
        panel.get_xaxis().set_major_formatter("{x:g}")
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("success, %")
    panels[-1].legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(1.0, 0.0))
    return figure
