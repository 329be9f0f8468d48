"""The matrix of a benchmark: which policies learn from which demonstrations, and on which seeds they are compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hdril.benchmark.steps import Evaluate, Play, Record, Step, Train

BESIDE = {
    "position_error_cm": "position, cm",
    "angle_error_rad": "angle, rad",
    "dtw_cm": "DTW, cm",
    "pc_expert_choice": "first primitive the expert's, %",
    "jerk_to_expert": "jerk, times the expert's",
    "pc_noticed": "says that it tried again, gave up or passed over, %",
    "pc_success_noticed": "success where it did, %",
}
"""What may stand beside success, by its name in ``results.json``, and what the column is called."""


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
    stray: float = 0.0
    """How far hands stray now and then, m, as hdril-record has it."""


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
    control: str = ""
    """The evaluation of the same seeds in which nothing happens, neither event nor mishap: tables tell by how much success falls
    from there. It must be cut after the same frames (--max_frames)."""
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
    margin: float = 0.0
    """Points by which success may fall where something happens: the table says of each evaluation that has a control whether it
    falls by no more. 0: it does not say."""
    beside: list[str] = field(default_factory=list)
    """What is shown beside success: errors against the expert (position_error_cm, angle_error_rad, dtw_cm), how often the policy
    begins with the expert's primitive (pc_expert_choice), its hands' jerk against the expert's (jerk_to_expert), in how many
    episodes it says that it tried again, gave something up or passed something over (pc_noticed), and how many of these succeed
    (pc_success_noticed). A policy without primitives says nothing."""
    by_primitive: bool = False
    """Whether the mean distance of the hands from the noise-free expert's has a table of its own, by the expert's primitive."""
    phases: dict[str, list[str]] = field(default_factory=dict)
    """Primitives that are told together in that table, by the name of the phase: each of them counts alike. Unless given, each
    primitive is told by itself."""
    published_by_primitive: dict[str, dict[str, float]] = field(default_factory=dict)
    """Numbers of others in that table, cm, by policy and primitive (or phase)."""
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
    used_seeds: Path | None = None
    """A YAML file of seeds by which choices were made before, a list of {task, first, last, why}. What is reported may not have
    them."""


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
        for count in table.demonstrations or [spec.episodes]:
            # A data set of its own: policies learn from statistics and names of the whole data set, too.
            record = Record(spec.task, count, spec.seed, spec.perturb, spec.stray)
            for policy in table.policies:
                for minutes in matrix.policies[policy].minutes or [0.0]:
                    trained = [training(matrix, policy, record, minutes, seed) for seed in table.training_seeds]
                    evaluations = {
                        key: tuple(_evaluate(matrix, key, train) for train in trained) for key in table.evaluations
                    }
                    yield Row(name, policy, count, minutes or None, evaluations)


def training(matrix: Matrix, name: str, data: Record, minutes: float, seed: int) -> Train:
    """The step that trains a policy of the matrix on ``data``, for ``minutes`` unless they are 0."""
    spec = matrix.policies[name]
    return Train(name, data, spec.config, tuple(spec.options), spec.steps, seed, minutes, spec.in_memory)


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


def drawn_data(matrix: Matrix, table: TableSpec) -> dict[str, Record]:
    """The demonstrations that are drawn, by name; of each, the largest set that is learned from."""
    if not table.trajectories:
        return {}
    ordered = sorted(rows(matrix, table), key=lambda row: row.demonstrations)
    return {row.data: row.trainings[0].data for row in ordered}


def all_steps(matrix: Matrix) -> list[Step]:
    """All that the report of a matrix is made of: the evaluations, and what is drawn."""
    episodes = [step for table in matrix.tables for step in drawn(matrix, table).values()]
    recorded = [step for table in matrix.tables for step in drawn_data(matrix, table).values()]
    return [*steps(matrix), *episodes, *recorded]
