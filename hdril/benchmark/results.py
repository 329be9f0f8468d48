"""What a benchmark found, as plain data: ``benchmark.json``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import asdict, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril.benchmark.engine import in_order
from hdril.benchmark.episode import EPISODE, places
from hdril.benchmark.matrix import EvaluationSpec, Matrix, Row, TableSpec, all_steps, drawn, drawn_data, rows, steps
from hdril.benchmark.steps import Evaluate, Play, Step, Train
from hdril.benchmark.store import Store
from hdril.demonstrations.read import read_episode
from hdril.digest import SHORT, digest_file, digest_json
from hdril.evaluation.checkpoint import read_json
from hdril.evaluation.statistics import (
    difference_over_trainings,
    holm,
    mcnemar_exact,
    paired_counts,
    wilson_interval,
)
from hdril.evaluation.stored import read_evaluation
from hdril.tasks import get_task

_NUMBERS = ("n_episodes", "n_success", "pc_success", "held_out", "position_error_cm", "angle_error_rad", "dtw_cm",
          "position_error_cm_by_primitive", "pc_expert_choice", "jerk_to_expert", "n_expert_failures",
          "stages_reached")  # fmt: skip


SIGNIFICANCE = 0.05
"""Family-wise error of a list of tests of trained policies."""
_SHAPE, _PLAIN_SHAPE = 5, 3
"""Of a table as data. It counts up when the report needs what older tables do not have: they are not kept then. A plain table,
without tests, falls and choices of demonstrations, is as it was."""

_LATER: dict[str, Any] = {
    "stray": 0.0, "margin": 0.0, "by_primitive": False, "phases": {}, "published_by_primitive": {},
}  # fmt: skip
"""Options that came later than reports which are kept. A definition that does not use them asks for what it asked for before."""


Kept = Mapping[str, Mapping[str, Any]]
"""Evaluations and drawn episodes that a report has, by their recipes."""
_RUN_SHAPE = 1
"""Of these as data. It counts up when one of them is told in another way: reports of before are read from the store again."""


def collect(matrix: Matrix, store: Store, kept: Kept | None = None) -> dict[str, Any]:
    """The numbers of all tables, each of whose steps is done or taken from those that are ``kept``.

    Raises:
        KeyError: a step is neither.
        ValueError: an evaluation holds other seeds than the matrix says.
    """
    return blank(matrix) | {"tables": [_table(matrix, table, store, kept or {}) for table in matrix.tables]}


def blank(matrix: Matrix) -> dict[str, Any]:
    """Results without a table."""
    return {
        "name": matrix.name,
        "tuning": matrix.tuning,
        "used_seeds": str(matrix.used_seeds or ""),
        "tables": [],
        "runs": [],
    }


def kept_runs(report: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What a report has of steps that need not be done again. Older reports do not say how their numbers were made."""
    return {run["recipe"]: run for run in runs_of(report) if run.get("shape") == _RUN_SHAPE}


def runs_of(report: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Evaluations and drawn episodes of a report: of no table yet, and of its tables."""
    yield from report.get("runs", [])
    for table in report.get("tables", []):
        yield from (run for row in table.get("rows", []) for runs in row["cells"].values() for run in runs)
        yield from table.get("episodes", {}).values()


def usable(matrix: Matrix, table: TableSpec, store: Store, kept: Kept) -> dict[str, Mapping[str, Any]]:
    """What a table takes from a report: all that it asks of a training, or else what is of the weights that the store has. So a
    row is of one trained policy: the same training may give other weights on another machine."""
    taken: dict[str, Mapping[str, Any]] = {}
    for training, recipes in _asked_of(matrix, table, store).items():
        runs = {recipe: kept[recipe] for recipe in recipes if recipe in kept}
        if not _whole(runs, recipes):
            done = store.find(training)
            runs = {recipe: run for recipe, run in runs.items() if done and _trained(run) == done.digest[:SHORT]}
        taken |= runs
    return taken


def torn(matrix: Matrix, table: TableSpec, store: Store, kept: Kept) -> list[Train]:
    """Trainings of which the report has a part of what a table asks. If they are done again and have the same weights, that part
    is :func:`usable`."""
    asked = _asked_of(matrix, table, store)
    found = {training: {recipe: kept[recipe] for recipe in asked[training] if recipe in kept} for training in asked}
    return [training for training, runs in found.items() if runs and not _whole(runs, asked[training])]


def _asked_of(matrix: Matrix, table: TableSpec, store: Store) -> dict[Train, set[str]]:
    """Recipes of what a table asks of each training."""
    evaluated = [step for row in rows(matrix, table) for steps in row.evaluations.values() for step in steps]
    asked: dict[Train, set[str]] = {step.policy: set() for step in evaluated}
    for step in evaluated:
        asked[step.policy].add(store.recipe(step))
    for step in drawn(matrix, table).values():
        asked[step.evaluation.policy].add(store.recipe(step))
    return asked


def _whole(runs: Kept, recipes: Set[str]) -> bool:
    """Whether these are all runs of the recipes, and of the same weights."""
    return runs.keys() == recipes and len({_trained(run) for run in runs.values()}) == 1


def _trained(run: Mapping[str, Any]) -> str:
    """Digest of the policy of a run."""
    return str(run["made_from"]["train"]["digest"])


def unfinished(matrix: Matrix, store: Store, results: Mapping[str, Any], runs: Kept) -> list[Mapping[str, Any]]:
    """Those of the ``runs`` that no table of the results has, and a table of the matrix still asks for."""
    asked = {store.recipe(step) for step in all_steps(matrix)} - kept_runs(results).keys()
    return [run for recipe, run in runs.items() if recipe in asked]


def keep_tables(matrix: Matrix, results: dict[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """Results of some tables, with those that an earlier report has of the others: whose definition has not changed since.

    The tables are in the order of the matrix.
    """
    specs = {table.title: table for table in matrix.tables}
    found = {table["title"]: table for table in results["tables"]}
    for table in before.get("tables", []):
        spec = specs.get(table.get("title"))
        if spec and spec.title not in found and table.get("made", {}).get("asked") == _asked(matrix, spec):
            found[spec.title] = table | {
                "note": spec.note,
                "published": spec.published,
                "published_by": spec.published_by,
                "published_by_primitive": spec.published_by_primitive,
                "data": _data(matrix, spec),
            }
    return results | {"tables": [found[title] for title in specs if title in found]}


def _data(matrix: Matrix, table: TableSpec) -> dict[str, Any]:
    return {name: vars(matrix.data[name]) for name in table.data}


def _asked(matrix: Matrix, table: TableSpec) -> str:
    """Digest of the definition of a table, its texts aside: what it names, and how that is defined."""
    wordless = _without_later(asdict(replace(table, note="", published={}, published_by="", published_by_primitive={})))
    policies = [
        asdict(spec) | {"config": digest_file(spec.config)}
        for spec in (matrix.policies[name] for name in table.policies)
    ]
    data, evaluations = (
        [_without_later(asdict(known[name])) for name in names]
        for names, known in ((table.data, matrix.data), (table.evaluations, matrix.evaluations))
    )
    plain = not (table.against or table.demonstrations or any(spec["control"] for spec in evaluations))
    shape = _PLAIN_SHAPE if plain else _SHAPE
    return digest_json([shape, wordless, data, policies, evaluations])[:SHORT]


def _without_later(definition: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in definition.items() if _LATER.get(key) != value}


def _made(matrix: Matrix, table: TableSpec, store: Store, runs: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What made a table: the versions that the evaluations used, the machines, and how many hours the steps took together."""
    told = [step for run in runs for step in (run, *run["made_from"].values())]
    seconds = {step["recipe"]: step["seconds"] for step in told}
    evaluated = [store.settings(step)["software"] for step in steps(replace(matrix, tables=[table]))]
    return {
        "asked": _asked(matrix, table),
        "software": {name: version for software in evaluated for name, version in software.items()},
        "machines": sorted({step["machine"] for step in told}),
        "commits": sorted({step["commit"] for step in told} - {""}),
        "hours": round(sum(seconds.values()) / 3600.0, 2),
    }


def _table(matrix: Matrix, table: TableSpec, store: Store, report: Kept) -> dict[str, Any]:
    kept = usable(matrix, table, store, report)
    found = [_row(row, store, kept) for row in rows(matrix, table)]
    episodes = {
        name: {**(kept.get(store.recipe(step)) or run_of(step, store)), "title": step.evaluation.policy.title}
        for name, step in drawn(matrix, table).items()
    }
    evaluated = [run for row in found for runs in row["cells"].values() for run in runs]
    return {
        "title": table.title,
        "note": table.note,
        "data": _data(matrix, table),
        "evaluations": {name: vars(matrix.evaluations[name]) for name in table.evaluations},
        "training_seeds": table.training_seeds,
        "rows": found,
        "against": table.against,
        "beside": table.beside,
        "published": table.published,
        "published_by": table.published_by,
        "by_primitive": _phases(matrix, table) if table.by_primitive else {},
        "published_by_primitive": table.published_by_primitive,
        "tests": _tests(matrix, table, found),
        "falls": _falls(matrix, table, found),
        "trajectories": {
            name: [places(read_episode(store.get(step).output, number).state) for number in range(table.trajectories)]
            for name, step in drawn_data(matrix, table).items()
        },
        "episodes": episodes,
        "made": _made(matrix, table, store, [*evaluated, *episodes.values()]),
    }


def _phases(matrix: Matrix, table: TableSpec) -> dict[str, list[str]]:
    """Primitives by what tells of them: their phase, or else each by itself, in the order of the task."""
    return table.phases or {name: [name] for name in get_task(matrix.data[table.data[0]].task).labels}


def _row(row: Row, store: Store, kept: Kept) -> dict[str, Any]:
    cells = {
        name: [kept.get(store.recipe(step)) or run_of(step, store) for step in steps]
        for name, steps in row.evaluations.items()
    }
    trained = [run["made_from"]["train"] for run in next(iter(cells.values()))]
    return {
        "data": row.data,
        "policy": row.policy,
        "demonstrations": row.demonstrations,
        "minutes": row.minutes,
        "steps": trained[0]["steps"],
        "training_minutes": [round(training["seconds"] / 60.0, 1) for training in trained],
        "cells": cells,
    }


def _provenance(step: Step, store: Store) -> dict[str, Any]:
    """How a step was done, and in ``made_from``, by kind, how all that it is made from was."""
    *inputs, _ = in_order([step])
    made_from = {other.kind: _how(other, store) for other in inputs}
    return _how(step, store) | {"shape": _RUN_SHAPE, "made_from": made_from}


def _how(step: Step, store: Store) -> dict[str, Any]:
    done = store.get(step)
    trained = {"steps": step.count_steps(store.input_folders(step))} if isinstance(step, Train) else {}
    return trained | {
        "recipe": store.recipe(step),
        "digest": done.digest[:SHORT],
        "command": store.relative(done.command),
        "seconds": done.seconds,
        "machine": done.machine,
        "commit": done.commit,
    }


def run_of(step: Evaluate | Play, store: Store) -> dict[str, Any]:
    """What an evaluation found, or an episode frame by frame, and how it was made.

    Raises:
        KeyError: it is not done.
        ValueError: it holds other seeds than were asked for, or seeds that are not known to be held out.
    """
    found = _found(step, store) if isinstance(step, Evaluate) else read_json(store.get(step).output / EPISODE)
    return found | _provenance(step, store)


def _found(step: Evaluate, store: Store) -> dict[str, Any]:
    """The numbers of an evaluation. ``failed_seeds`` lets a reader pair two policies."""
    done = store.get(step)
    results = read_evaluation(done.output).results
    if [episode["seed"] for episode in results["per_episode"]] != list(step.seeds):
        raise ValueError(f"{done.output} holds other seeds than {step.title} asks for")
    if results["held_out"] is not True:
        raise ValueError(
            f"{done.output} is no evaluation on held-out seeds: {results['held_out_basis'] or 'that was not checked'}"
        )
    interval = wilson_interval(results["n_success"], results["n_episodes"])
    telling = any(episode["primitives"] for episode in results["per_episode"])
    noticed = [episode["success"] for episode in results["per_episode"] if episode["noticed"]]
    return {key: results[key] for key in _NUMBERS} | {
        "pc_noticed": 100.0 * len(noticed) / results["n_episodes"] if telling else None,
        "pc_success_noticed": 100.0 * sum(noticed) / len(noticed) if noticed else None,
        "pc_success_ci95": [100.0 * bound for bound in interval],
        "training_seed": step.policy.seed,
        "weights": results["identity"]["policy"]["weights"],
        "failed_seeds": [episode["seed"] for episode in results["per_episode"] if not episode["success"]],
    }


def _outcomes(runs: Sequence[Mapping[str, Any]], evaluation: EvaluationSpec) -> NDArray[np.bool_]:
    """(trainings, seeds) success of the runs of a cell."""
    seeds = range(evaluation.seed, evaluation.seed + evaluation.episodes)
    return np.array([[seed not in failed for seed in seeds] for failed in (set(run["failed_seeds"]) for run in runs)])


def _tests(matrix: Matrix, table: TableSpec, found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Each policy against the one that the table names, on the same demonstrations and seeds."""
    if not table.against:
        return []
    tests = []
    for row, name in product(found, table.evaluations):
        if row["policy"] == table.against:
            continue
        base = _base(table, found, row)
        first, second = (_outcomes(entry["cells"][name], matrix.evaluations[name]) for entry in (row, base))
        named = _named(row) | {"against_minutes": base["minutes"], "evaluation": name}
        tests.append(named | _compare(first, second, same_trainings=False))
    return _adjusted(tests)


def _falls(matrix: Matrix, table: TableSpec, found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Each evaluation in which something happens against its control, on the same seeds and with the same weights."""
    falls = []
    for row, name in product(found, table.evaluations):
        if not (control := matrix.evaluations[name].control):
            continue
        first, second = (_outcomes(row["cells"][key], matrix.evaluations[key]) for key in (name, control))
        compared = _compare(first, second, same_trainings=True)
        within = _within(compared["pc_difference_ci95"], table.margin)
        falls.append(_named(row) | {"evaluation": name, "control": control} | compared | within)
    return _adjusted(falls)


def _within(interval: Sequence[float], margin: float) -> dict[str, Any]:
    """Whether success falls by no more than ``margin`` points, as far as the interval of the difference tells."""
    if not margin:
        return {}
    low, high = interval
    return {"margin": margin, "within": "yes" if low >= -margin else "no" if high < -margin else "not shown"}


def _named(row: Mapping[str, Any]) -> dict[str, Any]:
    """What tells a row from the others."""
    return {key: row[key] for key in ("data", "demonstrations", "policy", "minutes")}


def _adjusted(tests: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The tests, each with its p-values adjusted for all of them, and whether they show a difference.

    They do if every pair of trainings differs, all in the same direction, and the interval of the difference is on one side of 0.
    One training of each tells two trained policies apart, several of each two methods.
    """
    adjusted = iter(holm([p for test in tests for p in test["p_values"]]))
    for test in tests:
        test["p_values_holm"] = [next(adjusted) for _ in test["p_values"]]
        low, high = test["pc_difference_ci95"]
        one_side = any(
            all(sign * value > 0.0 for value in (*test["pc_differences"], low, high)) for sign in (1.0, -1.0)
        )
        test["differs"] = one_side and max(test["p_values_holm"]) < SIGNIFICANCE
    return tests


def _base(table: TableSpec, found: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> Mapping[str, Any]:
    """The row that a row is compared with: of the same minutes, or else of the most, as where one of the two has steps."""
    where = (row["data"], row["demonstrations"])
    bases = [
        other for other in found
        if other["policy"] == table.against and (other["data"], other["demonstrations"]) == where
    ]  # fmt: skip
    same = [other for other in bases if other["minutes"] == row["minutes"]]
    return max(same or bases, key=lambda other: other["minutes"] or 0.0)


def _compare(first: NDArray[np.bool_], second: NDArray[np.bool_], same_trainings: bool) -> dict[str, Any]:
    """The difference in success with its interval, and difference and p of each pair of trainings with the same seed.

    Args:
        first: (trainings, seeds) outcomes.
        second: (trainings, seeds) outcomes.
        same_trainings: both are of the same trained policies.
    """
    pairs = [
        paired_counts(dict(enumerate(a)), dict(enumerate(b)))
        for a, b in zip(first.tolist(), second.tolist(), strict=True)
    ]
    return {
        "pc_difference": 100.0 * float(first.mean() - second.mean()),
        "pc_difference_ci95": [
            100.0 * bound for bound in difference_over_trainings(first, second, same_trainings=same_trainings)
        ],
        "pc_differences": [100.0 * counts.difference for counts in pairs],
        "p_values": [mcnemar_exact(counts) for counts in pairs],
    }
