"""What a matrix must keep: names that are there, numbers in range, and evaluations on seeds that were held out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any

import yaml

from hdril.benchmark.matrix import BESIDE, DataSpec, EvaluationSpec, Matrix, PolicySpec, TableSpec, training
from hdril.benchmark.page import slug
from hdril.benchmark.steps import Record
from hdril.demonstrations.perturb import check_perturbation
from hdril.demonstrations.record import PATIENCE
from hdril.evaluation.identity import identify_trials
from hdril.files import MAX_SEED
from hdril.tasks import base_name, built_as, get_task

_DECIDED = ("resume", "dataset.episodes", "dataset.eval_split", "policy.path", "policy.pretrained_path")
"""What a training may learn from besides its demonstrations, or which of them it leaves out: not even a config file may say."""
_OF_TRAINING = (
    "config_path", "dataset", "dataset.root", "dataset.repo_id", "output_dir", "policy", "steps", "save_freq", "seed", *_DECIDED,
)  # fmt: skip
_OF_EVALUATION = (
    "config_path", "policy", "policy.path", "task", "num_episodes", "seed", "rerun", "workers", "output_dir", "against", "suite",
    "cells", "push", "shards", "shard", "executor", "training_data",
)  # fmt: skip
"""What the benchmark sets by itself, so that the matrix says what was done; or what it cannot keep track of."""
_FRAMES, _MISHAP = "max_frames", "mishap"


_ANY_TASK = "all"
"""In a file of used seeds."""
_LONGEST = 80
"""Letters of a title that names files."""


def check(matrix: Matrix) -> None:
    """Check a matrix; nothing is done.

    Raises:
        ValueError: a name that is not there, a number out of range, or seeds of an evaluation that are not held out; says which,
            and the valid choices.
        FileNotFoundError: there is no such config file.
    """
    if not re.fullmatch(r"[\w.-]+", matrix.name):
        raise ValueError(f"name must be of letters, digits, '.', '_' and '-', got {matrix.name!r}")
    for name, data in matrix.data.items():
        get_task(data.task)
        _check_seeds(f"data {name}", data.seed, data.episodes)
        try:
            check_perturbation(data.perturb, data.stray)
        except ValueError as error:
            raise ValueError(f"data {name}: {error}") from None
    for name, policy in matrix.policies.items():
        if not policy.config.exists():
            raise FileNotFoundError(f"policy {name}: there is no config file {policy.config}")
        _check_budget(name, policy)
        _check_config(name, policy.config)
        _check_options(f"policy {name}", policy.options, _OF_TRAINING)
        training(matrix, name, Record("table_lift", 1), 0.0, 0).settings()  # what it needs is there
    for name, evaluation in matrix.evaluations.items():
        get_task(evaluation.task)
        _check_seeds(f"evaluation {name}", evaluation.seed, evaluation.episodes)
        _check_options(f"evaluation {name}", evaluation.options, _OF_EVALUATION)
        try:
            _frames(evaluation)
        except ValueError as error:
            raise ValueError(f"evaluation {name}: {error}") from None
        if evaluation.control:
            _check_control(matrix, name, evaluation)
    for table in matrix.tables:
        _check_table(matrix, table)
    titles = [slug(table.title) for table in matrix.tables]
    if unfit := [
        table.title for table, name in zip(matrix.tables, titles, strict=True) if not 1 <= len(name) <= _LONGEST
    ]:
        raise ValueError(f"a title names files: it needs 1 to {_LONGEST} letters and digits, got {unfit[0]!r}")
    if unfit := [table.title for table in matrix.tables if set("[]") & set(table.title)]:
        raise ValueError(f"a title must be without brackets, got {unfit[0]!r}")
    if alike := [table.title for table in matrix.tables if titles.count(slug(table.title)) > 1]:
        raise ValueError(
            f"tables need titles that differ in letters or digits; alike are {' and '.join(map(repr, alike))}"
        )
    check_held_out(matrix)


def _check_budget(name: str, policy: PolicySpec) -> None:
    if policy.steps < 0 or bool(policy.steps) == bool(policy.minutes):
        raise ValueError(
            f"policy {name}: give steps, at least 1, or else minutes; got {policy.steps} steps and {policy.minutes} minutes"
        )
    if wrong := [minutes for minutes in policy.minutes if not 0.0 < minutes < inf or policy.minutes.count(minutes) > 1]:
        raise ValueError(f"policy {name}: minutes must be above 0 and differ, got {wrong[0]:g}")


def _check_config(name: str, path: Path) -> None:
    """Raises ValueError if a config file of lerobot-train says what the benchmark decides."""
    told = yaml.safe_load(path.read_text())
    if not isinstance(told, dict):
        raise ValueError(f"policy {name}: {path} holds no options")
    for option in _DECIDED:
        group, _, key = option.rpartition(".")
        values = told.get(group) if group else told
        if isinstance(values, dict) and values.get(key):
            raise ValueError(f"policy {name}: {path} must not say {option}")


def _check_options(what: str, options: list[str], known: tuple[str, ...]) -> None:
    """Raises ValueError for an option that the benchmark sets, or that would set others unseen."""
    for option in options:
        if (name := _named(option)) in known:
            raise ValueError(f"{what}: --{name} cannot be among its options")


def _check_seeds(what: str, first: int, count: int) -> None:
    if count < 1:
        raise ValueError(f"{what}: episodes must be at least 1, got {count}")
    if not 0 <= first <= MAX_SEED + 1 - count:
        raise ValueError(f"{what}: seed must be from 0 to {MAX_SEED + 1 - count}, got {first}")


def _check_control(matrix: Matrix, name: str, evaluation: EvaluationSpec) -> None:
    """Raises ValueError unless episodes and their controls are of the same scenes, and may take as long."""
    control = matrix.evaluations.get(evaluation.control)
    if control is None:
        raise ValueError(
            f"evaluation {name}: control has no {evaluation.control!r}; choose from: {', '.join(matrix.evaluations)}"
        )
    first, second = (
        (built_as(spec.task), get_task(spec.task).variation.spans, _seeds(spec)) for spec in (evaluation, control)
    )
    if first != second:
        raise ValueError(f"evaluation {name}: its control {evaluation.control} is not of the same scenes")
    ours, theirs = (
        [option for option in spec.options if _named(option) not in (_FRAMES, _MISHAP)]
        for spec in (evaluation, control)
    )
    if ours != theirs:
        raise ValueError(f"evaluation {name}: its control {evaluation.control} has other options")
    if get_task(evaluation.task).state_names != get_task(control.task).state_names:
        raise ValueError(
            f"evaluation {name}: its control {evaluation.control} observes other numbers: set detailed=1 in it"
        )
    happens = [_something_happens(spec) for spec in (evaluation, control)]
    if happens != [True, False]:
        raise ValueError(
            f"evaluation {name}: something must happen in it, and nothing in its control {evaluation.control}"
        )
    if (ours := _frames(evaluation)) != (theirs := _frames(control)):
        raise ValueError(
            f"evaluation {name} is cut after {ours} frames, its control {evaluation.control} after {theirs}: give --max_frames"
        )


def _frames(evaluation: EvaluationSpec) -> int:
    """Frames after which its episodes are cut."""
    given = _given(evaluation, _FRAMES)
    if given and not given.isdecimal():
        raise ValueError(f"{_FRAMES} must be a whole number of frames, got {given!r}")
    frames = int(given) if given else None
    return identify_trials(evaluation.task, 0, 1, frames, _given(evaluation, _MISHAP)).max_frames


def _something_happens(evaluation: EvaluationSpec) -> bool:
    """Whether something disturbs the scene, or the policy's actions."""
    variation = get_task(evaluation.task).variation
    return bool(variation.rates or variation.any_event or _given(evaluation, _MISHAP))


def _given(evaluation: EvaluationSpec, option: str) -> str:
    """What an option of an evaluation was given, the last time; empty if it was not."""
    found = [each.partition("=")[2] for each in evaluation.options if _named(each) == option]
    return found[-1] if found else ""


def _named(option: str) -> str:
    """An option's name as its field has it; hdril-eval takes dashes, too."""
    return option.partition("=")[0].removeprefix("--").replace("-", "_")


def _check_table(matrix: Matrix, table: TableSpec) -> None:
    for kind, names, known in (
        ("data", table.data, matrix.data),
        ("policies", table.policies, matrix.policies),
        ("evaluations", table.evaluations, matrix.evaluations),
        ("against", [table.against] if table.against else [], table.policies),
        ("beside", table.beside, BESIDE),
        ("published", list(table.published), table.policies),
        ("published_by_primitive", list(table.published_by_primitive), table.policies),
    ):
        if missing := [name for name in names if name not in known]:
            raise ValueError(f"table {table.title!r}: {kind} has no {missing[0]!r}; choose from: {', '.join(known)}")
        if not names and kind in ("data", "policies", "evaluations"):
            raise ValueError(f"table {table.title!r} names no {kind}; choose from: {', '.join(known)}")
        _check_once(table, kind, names)
    _check_by_primitive(matrix, table)
    _check_once(table, "training_seeds", table.training_seeds)
    _check_once(table, "demonstrations", table.demonstrations)
    if not table.training_seeds:
        raise ValueError(f"table {table.title!r} names no training_seeds")
    for name in table.evaluations:
        if (control := matrix.evaluations[name].control) and control not in table.evaluations:
            raise ValueError(f"table {table.title!r}: {name} needs its control {control} among the evaluations")
    if not 0.0 <= table.margin <= 100.0:
        raise ValueError(f"table {table.title!r}: margin must be from 0 to 100 points, got {table.margin:g}")
    if table.margin and not any(matrix.evaluations[name].control for name in table.evaluations):
        raise ValueError(f"table {table.title!r}: a margin is for evaluations that have a control, and there are none")
    for name in table.evaluations if table.episode >= 0 else []:
        if table.episode not in (seeds := _seeds(matrix.evaluations[name])):
            raise ValueError(
                f"table {table.title!r}: episode must be a seed of {name}, {seeds.start} to {seeds[-1]}, got {table.episode}"
            )
    for name in table.data:
        most = matrix.data[name].episodes
        shown = max(table.demonstrations or [most])
        if wrong := [count for count in table.demonstrations if not 1 <= count <= most]:
            raise ValueError(f"table {table.title!r}: data {name} has 1 to {most} demonstrations, got {wrong[0]}")
        if not 0 <= table.trajectories <= shown:
            raise ValueError(f"table {table.title!r}: trajectories must be from 0 to {shown}, got {table.trajectories}")
        task = base_name(matrix.data[name].task)
        if other := [key for key in table.evaluations if base_name(matrix.evaluations[key].task) != task]:
            raise ValueError(f"table {table.title!r}: evaluation {other[0]} is not of {task}, the task of data {name}")


def _check_by_primitive(matrix: Matrix, table: TableSpec) -> None:
    """The table of errors by primitive; numbers of others must be in one of its columns."""
    if not table.by_primitive:
        if table.phases or table.published_by_primitive:
            raise ValueError(f"table {table.title!r}: phases and published_by_primitive need by_primitive=true")
        return
    labels = get_task(matrix.data[table.data[0]].task).labels
    for phase, primitives in table.phases.items():
        if unknown := [name for name in primitives if name not in labels]:
            raise ValueError(f"table {table.title!r}: {phase} has no {unknown[0]!r}; choose from: {', '.join(labels)}")
        _check_once(table, phase, primitives)
        if not primitives:
            raise ValueError(f"table {table.title!r}: {phase} names no primitive; choose from: {', '.join(labels)}")
    columns = table.phases or labels
    for policy, told in table.published_by_primitive.items():
        if unknown := [name for name in told if name not in columns]:
            raise ValueError(
                f"table {table.title!r}: published_by_primitive of {policy} has {unknown[0]!r}; choose from: {', '.join(columns)}"
            )


def _check_once(table: TableSpec, kind: str, values: Sequence[object]) -> None:
    if twice := [value for value in values if values.count(value) > 1]:
        raise ValueError(f"table {table.title!r}: {kind} has {twice[0]!r} twice")


def check_held_out(matrix: Matrix) -> None:
    """Check that the seeds of what is reported were neither trained nor tuned on.

    A seed decides the whole scene of a task, whatever its parameters, so that the level does not matter.

    Raises:
        ValueError: they were; names both uses.
    """
    used = [
        *((f"data {name}", base_name(spec.task), _seeds(spec)) for name, spec in matrix.data.items()),
        *((f"tuning on {name}", base_name(e.task), _seeds(e)) for name, e in matrix.evaluations.items() if e.tuning),
        *_used_before(matrix.used_seeds),
    ]
    for name, evaluation in matrix.evaluations.items():
        seeds, task = _seeds(evaluation), base_name(evaluation.task)
        for use, other, theirs in used[: len(matrix.data)] if evaluation.tuning else used:
            common = range(max(seeds.start, theirs.start), min(seeds.stop, theirs.stop))
            if other in (task, _ANY_TASK) and common:
                raise ValueError(
                    f"evaluation {name} is not held out: {use} has its seeds {common.start} to {common[-1]} of {task}, too"
                )
    for table in matrix.tables:
        for name in table.evaluations:
            if matrix.evaluations[name].tuning and not matrix.tuning:
                raise ValueError(
                    f"table {table.title!r}: {name} is for tuning, and so must be the matrix (tuning: true)"
                )
            if matrix.tuning and not matrix.evaluations[name].tuning:
                raise ValueError(
                    f"table {table.title!r}: the matrix is for tuning, and so must be {name} (tuning: true)"
                )


def _used_before(path: Path | None) -> list[tuple[str, str, range]]:
    """Seeds in a file by which choices were made: what for, of which task, and which.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it holds something else.
    """
    if path is None:
        return []
    try:
        entries: Any = yaml.safe_load(path.read_text())
        found = [(f"{path} ({entry['why']})", str(entry["task"]), (entry["first"], entry["last"])) for entry in entries]
    except (KeyError, TypeError, yaml.YAMLError):
        raise ValueError(f"{path} must be a list of entries with task, first, last and why") from None
    for _, task, (first, last) in found:
        if task != _ANY_TASK:
            get_task(task)
        if not (isinstance(first, int) and isinstance(last, int) and 0 <= first <= last):
            raise ValueError(f"{path}: first and last must be seeds in this order, got {first} and {last}")
    if not found:
        raise ValueError(f"{path} must name at least one seed")
    return [
        (why, task if task == _ANY_TASK else base_name(task), range(first, last + 1))
        for why, task, (first, last) in found
    ]


def _seeds(spec: DataSpec | EvaluationSpec) -> range:
    if isinstance(spec, EvaluationSpec):
        return range(spec.seed, spec.seed + spec.episodes)
    # Demonstrations that fail are dropped, and further seeds take their place.
    return range(spec.seed, spec.seed + 2 * spec.episodes + PATIENCE)
