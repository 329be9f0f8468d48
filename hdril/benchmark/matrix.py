"""The matrix of a benchmark: which policies learn from which demonstrations, and on which seeds they are compared."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path

from hdril.benchmark.steps import Evaluate, Play, Record, Step, Train
from hdril.demonstrations.record import PATIENCE
from hdril.files import MAX_SEED
from hdril.tasks import base_name, get_task

_OF_TRAINING = (
    "config_path", "dataset.root", "dataset.repo_id", "dataset.episodes", "output_dir", "steps", "save_freq", "seed", "resume",
    "policy.path", "policy.pretrained_path",
)  # fmt: skip
_OF_EVALUATION = (
    "config_path", "policy.path", "task", "num_episodes", "seed", "rerun", "workers", "output_dir", "against", "suite", "cells",
    "push", "shards", "shard", "executor",
)  # fmt: skip
"""What the benchmark sets by itself, so that the matrix says what was done; or what it cannot keep track of."""

ERRORS = {"position_error_cm": "position, cm", "angle_error_rad": "angle, rad", "dtw_cm": "DTW, cm"}
"""Errors against the expert by their name in ``results.json``, and what a column is called."""


@dataclass
class DataSpec:
    """Demonstrations."""

    task: str
    """Name of the task, with its parameters (table_lift:level=varied, table_lift:push=0.3)."""
    episodes: int
    """Episodes to record."""
    seed: int = 0
    """First seed."""
    perturb: float = 0.0
    """Noise that the robot gets and the record does not, m, as hdril-record has it."""


@dataclass
class PolicySpec:
    """A policy, and how it is trained."""

    steps: int = 0
    """Steps of training."""
    minutes: list[float] = field(default_factory=list)
    """Instead of steps: budgets of training on one core, the start of the command included; each is a row of its own. How many
    steps fit into them is measured first."""
    config: Path = Path("configs/train/table_lift.yaml")
    """Config file of lerobot-train."""
    options: list[str] = field(default_factory=list)
    """Further options of lerobot-train."""
    in_memory: bool = False
    """Hold the frames in memory (python -m lerobot_policy_hdril.in_memory): for policies that learn from windows of frames."""


@dataclass
class EvaluationSpec:
    """Seeds of a task on which policies are evaluated."""

    task: str
    """Name of the task, with its parameters."""
    episodes: int
    """Seeds."""
    seed: int
    """First seed. No training and no tuning may use these seeds."""
    options: list[str] = field(default_factory=list)
    """Further options of hdril-eval, such as --policy.rollout=open_loop."""
    tuning: bool = False
    """Whether choices are made by the results. Other evaluations must have other seeds, and only a matrix that is for tuning
    has a table of these."""


@dataclass
class TableSpec:
    """A table: rows are policies on demonstrations, columns are evaluations."""

    title: str
    """Its heading."""
    data: list[str]
    """Names of demonstrations."""
    policies: list[str]
    """Names of policies."""
    evaluations: list[str]
    """Names of evaluations."""
    demonstrations: list[int] = field(default_factory=list)
    """How many of the demonstrations are learned from, the first ones; all unless given."""
    training_seeds: list[int] = field(default_factory=lambda: [1000])
    """Seeds of weights and batches, one training each."""
    against: str = ""
    """The policy that the others are compared with, on the same demonstrations and seeds."""
    errors: list[str] = field(default_factory=list)
    """Errors against the expert that are shown beside success: position_error_cm, angle_error_rad, dtw_cm."""
    trajectories: int = 0
    """How many of the demonstrations are drawn, the first ones, with one of them highlighted."""
    episode: int = -1
    """A seed of the evaluations that is drawn: the first training of ``against``, or else of the first policy, with the most
    minutes and demonstrations, on the first data. None unless given."""
    published: dict[str, str] = field(default_factory=dict)
    """Numbers of others beside ours, as text, by policy."""
    published_by: str = "published"
    """Whose they are: the heading of their column."""
    note: str = ""
    """What a reader should know, as Markdown."""


@dataclass
class Matrix:
    """All that a benchmark does."""

    name: str
    """Of the benchmark."""
    data: dict[str, DataSpec]
    """Demonstrations by name."""
    policies: dict[str, PolicySpec]
    """Policies by name."""
    evaluations: dict[str, EvaluationSpec]
    """Evaluations by name."""
    tables: list[TableSpec]
    """What is reported."""
    tuning: bool = False
    """Whether choices are made by the results. The report then says so, and every evaluation must be for tuning."""


@dataclass(frozen=True)
class Row:
    """A row of a table: a policy that was trained once for each training seed."""

    data: str
    policy: str
    demonstrations: int
    minutes: float | None
    """Budget of training; None where the steps are given."""
    evaluations: Mapping[str, tuple[Evaluate, ...]]
    """By name; one for each training seed."""

    @property
    def trainings(self) -> tuple[Train, ...]:
        return tuple(step.policy for step in next(iter(self.evaluations.values())))


def rows(matrix: Matrix, table: TableSpec) -> Iterator[Row]:
    """The rows of a table, with the steps that fill them."""
    for name in table.data:
        spec = matrix.data[name]
        record = Record(spec.task, spec.episodes, spec.seed, spec.perturb)
        for count in table.demonstrations or [spec.episodes]:
            for policy in table.policies:
                for minutes in matrix.policies[policy].minutes or [0.0]:
                    trained = [_train(matrix, policy, record, count, minutes, seed) for seed in table.training_seeds]
                    evaluations = {
                        key: tuple(_evaluate(matrix, key, train) for train in trained) for key in table.evaluations
                    }
                    yield Row(name, policy, count, minutes or None, evaluations)


def _train(matrix: Matrix, name: str, data: Record, episodes: int, minutes: float, seed: int) -> Train:
    spec = matrix.policies[name]
    return Train(name, data, episodes, spec.config, tuple(spec.options), spec.steps, seed, minutes, spec.in_memory)


def _evaluate(matrix: Matrix, name: str, policy: Train) -> Evaluate:
    spec = matrix.evaluations[name]
    return Evaluate(name, policy, spec.task, spec.episodes, spec.seed, tuple(spec.options))


def steps(matrix: Matrix) -> list[Evaluate]:
    """The evaluations of all tables, each of which is made from all that comes before it."""
    found = {step: None for table in matrix.tables for row in rows(matrix, table) for entry in row.evaluations.values()
             for step in entry}  # fmt: skip
    return list(found)


def drawn(matrix: Matrix, table: TableSpec) -> dict[str, Play]:
    """The episodes that are drawn, by evaluation."""
    if table.episode < 0:
        return {}
    policy = table.against or table.policies[0]
    candidates = [row for row in rows(matrix, table) if (row.data, row.policy) == (table.data[0], policy)]
    row = max(candidates, key=lambda row: (row.minutes or 0.0, row.demonstrations))
    return {name: Play(evaluated[0], table.episode) for name, evaluated in row.evaluations.items()}


def all_steps(matrix: Matrix) -> list[Step]:
    """All that the report of a matrix is made of: the evaluations, and the episodes that are drawn."""
    return [*steps(matrix), *(step for table in matrix.tables for step in drawn(matrix, table).values())]


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
        if data.perturb < 0.0:
            raise ValueError(f"data {name}: perturb must not be negative, got {data.perturb}")
    for name, policy in matrix.policies.items():
        if not policy.config.exists():
            raise FileNotFoundError(f"policy {name}: there is no config file {policy.config}")
        _check_budget(name, policy)
        _check_options(f"policy {name}", policy.options, _OF_TRAINING)
        _train(matrix, name, Record("table_lift", 1), 1, 0.0, 0).settings()  # what it needs is there
    for name, evaluation in matrix.evaluations.items():
        get_task(evaluation.task)
        _check_seeds(f"evaluation {name}", evaluation.seed, evaluation.episodes)
        _check_options(f"evaluation {name}", evaluation.options, _OF_EVALUATION)
    for table in matrix.tables:
        _check_table(matrix, table)
    check_held_out(matrix)


def _check_budget(name: str, policy: PolicySpec) -> None:
    if policy.steps < 0 or bool(policy.steps) == bool(policy.minutes):
        raise ValueError(
            f"policy {name}: give steps, at least 1, or else minutes; got {policy.steps} steps and {policy.minutes} minutes"
        )
    if wrong := [minutes for minutes in policy.minutes if not 0.0 < minutes < inf or policy.minutes.count(minutes) > 1]:
        raise ValueError(f"policy {name}: minutes must be above 0 and differ, got {wrong[0]:g}")


def _check_options(what: str, options: list[str], known: tuple[str, ...]) -> None:
    """Raises ValueError for an option that the benchmark sets, or that would set others unseen."""
    for option in options:
        name = option.partition("=")[0].replace("-", "_").removeprefix("__")
        if name in known:
            raise ValueError(f"{what}: --{name} cannot be among its options")


def _check_seeds(what: str, first: int, count: int) -> None:
    if count < 1:
        raise ValueError(f"{what}: episodes must be at least 1, got {count}")
    if not 0 <= first <= MAX_SEED + 1 - count:
        raise ValueError(f"{what}: seed must be from 0 to {MAX_SEED + 1 - count}, got {first}")


def _check_table(matrix: Matrix, table: TableSpec) -> None:
    for kind, names, known in (
        ("data", table.data, matrix.data),
        ("policies", table.policies, matrix.policies),
        ("evaluations", table.evaluations, matrix.evaluations),
        ("against", [table.against] if table.against else [], table.policies),
        ("errors", table.errors, ERRORS),
        ("published", list(table.published), table.policies),
    ):
        if missing := [name for name in names if name not in known]:
            raise ValueError(f"table {table.title!r}: {kind} has no {missing[0]!r}; choose from: {', '.join(known)}")
        if not names and kind not in ("against", "errors", "published"):
            raise ValueError(f"table {table.title!r} names no {kind}; choose from: {', '.join(known)}")
        _check_once(table, kind, names)
    _check_once(table, "training_seeds", table.training_seeds)
    _check_once(table, "demonstrations", table.demonstrations)
    if not table.training_seeds:
        raise ValueError(f"table {table.title!r} names no training_seeds")
    for name in table.evaluations if table.episode >= 0 else []:
        if table.episode not in (seeds := _seeds(matrix.evaluations[name])):
            raise ValueError(
                f"table {table.title!r}: episode must be a seed of {name}, {seeds.start} to {seeds[-1]}, got {table.episode}"
            )
    for name in table.data:
        most = matrix.data[name].episodes
        if wrong := [count for count in table.demonstrations if not 1 <= count <= most]:
            raise ValueError(f"table {table.title!r}: data {name} has 1 to {most} demonstrations, got {wrong[0]}")
        if not 0 <= table.trajectories <= most:
            raise ValueError(f"table {table.title!r}: trajectories must be from 0 to {most}, got {table.trajectories}")
        task = base_name(matrix.data[name].task)
        if other := [key for key in table.evaluations if base_name(matrix.evaluations[key].task) != task]:
            raise ValueError(f"table {table.title!r}: evaluation {other[0]} is not of {task}, the task of data {name}")


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
    ]
    for name, evaluation in matrix.evaluations.items():
        if evaluation.tuning:
            continue
        seeds, task = _seeds(evaluation), base_name(evaluation.task)
        for use, other, theirs in used:
            common = range(max(seeds.start, theirs.start), min(seeds.stop, theirs.stop))
            if other == task and common:
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


def _seeds(spec: DataSpec | EvaluationSpec) -> range:
    if isinstance(spec, EvaluationSpec):
        return range(spec.seed, spec.seed + spec.episodes)
    # Demonstrations that fail are dropped, and further seeds take their place.
    return range(spec.seed, spec.seed + 2 * spec.episodes + PATIENCE)
