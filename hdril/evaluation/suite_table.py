"""The table of a suite as plain data: ``suite.json``.

Rates are in percent; ``pc_difference`` and what belongs to it are in percentage points. ``null`` stands for what does not apply.

====================================  =================================================================================
key                                   meaning
====================================  =================================================================================
``suite``, ``task``, ``policy``       what was asked for
``first_seed``, ``num_episodes``      the seeds of every cell
``held_out``, ``held_out_basis``      as in ``results.json``
``identity``                          what made the results, see :class:`hdril.evaluation.identity.PolicyIdentity`
``rows``                              an object for each cell, in the order of the table
``rows[].cell``, ``rows[].kind``      name and kind of the cell: ``nominal``, ``factor``, ``varied``, ``event``, ``hard``
``rows[].task``                       the task with its parameters
``rows[].control``                    the cell of ``controls`` with the same scenes without events; null without events
``rows[].n_success``                  episodes that succeeded
``rows[].pc_success``                 success rate, %
``rows[].pc_success_ci95``            its 95 % interval (Wilson), %: ``[low, high]``
``rows[].against_nominal``            a pair: this cell against the nominal one, on the same seeds; null for the nominal one
``rows[].against_control``            a pair: with events against without, in the same scenes; null without events
``rows[].stages``                     mean number of stages that were reached, success being the last
``rows[].n_stages``                   how many stages there are, success included
``rows[].n_expert_failures``          seeds on which the expert itself fails
``rows[].motion``                     means of the numbers of :class:`hdril.evaluation.motion.Motion`, by name
``controls``                          the same objects for the controls
``hdril_version``                     version of hdril
====================================  =================================================================================

A pair has the keys ``both``, ``first_only``, ``second_only``, ``neither`` (seeds on which both, this cell alone, the other
alone, or neither succeeded), ``pc_difference`` (success rate of this cell minus the other's), ``pc_difference_ci95`` (Newcombe's
method 10) and ``p_value`` (McNemar's exact test, two-sided). Pairs with controls have also ``p_holm``: adjusted for all of them,
by Holm's method.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from hdril import __version__
from hdril.evaluation.statistics import PairedCounts, holm, mcnemar_exact, paired_counts, paired_difference_interval
from hdril.evaluation.suite import NOMINAL, Cell
from hdril.tasks import get_task

Results = Mapping[str, Any]
"""The data of a cell's ``results.json``."""


def tabulate_suite(suite: str, task: str, cells: Sequence[Cell], results: Mapping[str, Results]) -> dict[str, Any]:
    """The data of ``suite.json``.

    Args:
        suite: its name.
        task: the task, as given.
        cells: rows and controls.
        results: by the cell's name.

    Raises:
        ValueError: a cell and its control are of other scenes.
    """
    rows = [_row(cell, results) for cell in cells]
    pairs = [row["against_control"] for row in rows if row["against_control"]]
    for pair, adjusted in zip(pairs, holm([pair["p_value"] for pair in pairs]), strict=True):
        pair["p_holm"] = adjusted
    nominal = results[NOMINAL]
    shared = ("policy", "overrides", "first_seed", "num_episodes", "held_out", "held_out_basis")
    return {
        "suite": suite,
        "task": task,
        **{key: nominal[key] for key in shared},
        "identity": nominal["identity"]["policy"],
        "rows": [row for row in rows if row["kind"] != "control"],
        "controls": [row for row in rows if row["kind"] == "control"],
        "hdril_version": __version__,
    }


def _row(cell: Cell, results: Mapping[str, Results]) -> dict[str, Any]:
    ours = results[cell.name]
    control = results.get(cell.control)
    if control is not None:
        _require_same_scenes(cell, ours, control)
    return {
        "cell": cell.name,
        "kind": cell.kind,
        "task": cell.task,
        "control": cell.control or None,
        **{key: ours[key] for key in ("n_success", "pc_success", "pc_success_ci95", "n_expert_failures")},
        "against_nominal": None if cell.name == NOMINAL else _pair(ours, results[NOMINAL]),
        "against_control": None if control is None else _pair(ours, control),
        "stages": float(np.mean([episode["stages"] for episode in ours["per_episode"]])),
        "n_stages": len(get_task(cell.task).stages) + 1,
        "motion": {name: spread["mean"] for name, spread in ours["motion"].items()},
    }


def _pair(ours: Results, other: Results) -> dict[str, Any]:
    counts: PairedCounts = paired_counts(_success(ours), _success(other))
    low, high = paired_difference_interval(counts)
    return {
        **asdict(counts),
        "pc_difference": 100.0 * counts.difference,
        "pc_difference_ci95": [100.0 * low, 100.0 * high],
        "p_value": mcnemar_exact(counts),
    }


def _success(results: Results) -> dict[int, bool]:
    return {int(episode["seed"]): bool(episode["success"]) for episode in results["per_episode"]}


def _require_same_scenes(cell: Cell, ours: Results, control: Results) -> None:
    for one, other in zip(ours["per_episode"], control["per_episode"], strict=True):
        scenes = [json.loads(episode["scenario"]) for episode in (one, other)]
        first, second = ({key: scene[key] for key in ("seed", "values", "poses")} for scene in scenes)
        if first != second:
            raise ValueError(f"seed {one['seed']} of {cell.name} and of {cell.control} are other scenes: no pair")
