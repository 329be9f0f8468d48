"""hdril-benchmark: policies, trained on demonstrations and evaluated on held-out seeds, by one config file."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock
from tqdm import tqdm

from hdril.benchmark.check import check
from hdril.benchmark.engine import Engine, Progress, in_order
from hdril.benchmark.matrix import Matrix, all_steps
from hdril.benchmark.page import numbers_file, read_numbers, write_numbers, write_report
from hdril.benchmark.perform import is_running
from hdril.benchmark.results import Kept, blank, collect, keep_tables, kept_runs, run_of, torn, unfinished, usable
from hdril.benchmark.steps import Evaluate, Play, Step
from hdril.benchmark.store import Store
from hdril.cli.common import run
from hdril.cli.shards import log_folder
from hdril.errors import UserError
from hdril.execution import SlurmConfig, check_execution, submit_to_slurm
from hdril.files import LOCK, is_busy


@dataclass
class BenchmarkConfig(Matrix):
    """Record, train and evaluate what a matrix names, and report it with statistics.

    Results are kept by what they are made from. After Ctrl-C or a kill, the same command goes on, and a step whose options,
    inputs or software changed is done anew. Several of these commands may run at once. An evaluation that the report has is not
    done again, even if the store is lost.
    """

    store: Path = Path("outputs/benchmark/store")
    """Folder of all results."""
    document: Path | None = None
    """Where the report goes, without suffix: .html, .md, .json and figures. Default: outputs/benchmark/<name>/<name>. To do
    again what one has, give another, and another store."""
    only: list[str] = field(default_factory=list)
    """Titles of tables to do, ["Table lift"]; all unless given. The others stay in the report as it has them, if their definition
    has not changed."""
    jobs: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Steps at a time; each has one thread."""
    plan: bool = False
    """Do nothing: print what is done, what runs and what is left."""
    executor: str = "local"
    """Who does the steps: local, this machine; slurm, jobs of a Slurm cluster, and this command ends when they are submitted.
    The disk must be shared."""
    shards: int = 1
    """Jobs of --executor=slurm, each of which does one step after the other; a last one reports."""
    slurm: SlurmConfig = field(default_factory=SlurmConfig)
    """What these jobs may take."""

    @property
    def chosen(self) -> Matrix:
        """The matrix with the tables that are to be done."""
        values = {item.name: getattr(self, item.name) for item in fields(Matrix)}
        tables = [table for table in self.tables if table.title in self.only or not self.only]
        return replace(Matrix(**values), tables=tables)


def benchmark_command(config: BenchmarkConfig) -> None:
    """Do what is left, and report."""
    check(config)
    if unknown := [title for title in config.only if title not in {table.title for table in config.tables}]:
        titles = ", ".join(repr(table.title) for table in config.tables)
        raise ValueError(f"only has no table {unknown[0]!r}; choose from: {titles}")
    if not re.fullmatch(r"[\w.-]+", _document(config).name):
        raise ValueError(f"document must end with letters, digits, '.', '_' and '-', got {_document(config).name!r}")
    if config.jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {config.jobs}")
    if config.executor not in ("local", "slurm"):
        raise ValueError(f"executor must be local or slurm, got {config.executor!r}")
    if config.executor == "local" and (config.shards != 1 or config.slurm != SlurmConfig()):
        raise ValueError("--shards and --slurm.* are for --executor=slurm; --jobs is for this machine")
    if not config.plan:
        check_execution(config.executor, config.shards, config.slurm)
    store, kept = Store(config.store), kept_runs(_report_before(config))
    if config.plan:
        _print_plan(config, store, kept)
        return
    if config.executor == "slurm":
        _submit(config)
        return
    _do(config, store, kept, partial(_show, config, store))
    results, document = collect(config.chosen, store, kept), _document(config)
    with _alone(config):
        before = _report_before(config)
        results = keep_tables(config, results, before)
        results["runs"] = unfinished(config, store, results, kept_runs(before))
        titles = {table["title"] for table in results["tables"]}
        gone = [table["title"] for table in before.get("tables", []) if table["title"] not in titles]
        write_report(document, results, gone)
    if gone:
        print(f"No longer in the report, because they are asked for in another way now: {', '.join(gone)}")
    if stale := len(kept_runs(before).keys() - kept_runs(results).keys()):
        print(f"Evaluations that left the report, as no table asks for them with these options and versions: {stale}")
    print(f"Report: {document}.html, and as Markdown beside it")


def _left(config: BenchmarkConfig, store: Store, kept: Kept) -> list[Step]:
    """What the tables that are to be done are made of, without what the report has."""
    left: dict[Step, None] = {}
    for table in config.chosen.tables:
        had = usable(config, table, store, kept)
        asked = all_steps(replace(config.chosen, tables=[table]))
        left |= dict.fromkeys(step for step in asked if store.recipe(step) not in had)
    return list(left)


def _do(config: BenchmarkConfig, store: Store, kept: Kept, run: Callable[[list[Step]], None]) -> None:
    """Do what is left: first the trainings of which the report has a part, whose weights decide what of that is left."""
    if parts := [step for table in config.chosen.tables for step in torn(config, table, store, kept)]:
        with suppress(UserError):  # it fails again below, and keeps back nothing else there
            run(list(parts))
    run(_left(config, store, kept))


def _show(config: BenchmarkConfig, store: Store, wanted: list[Step]) -> None:
    """Do steps, and show how far it is."""
    with tqdm(total=len(in_order(wanted)), desc=config.name, unit="step") as bar:

        def watch(step: Step, progress: Progress) -> None:
            seconds = progress.remaining()
            if progress.fresh:
                bar.write(f"{store.get(step).seconds:6.0f} s  {step.title}")
            _keep(config, store, step)
            bar.set_postfix_str("" if seconds is None else f"about {_in_words(seconds)} left")
            bar.update()

        Engine(store, config.jobs, watch).run(wanted)


def _keep(config: BenchmarkConfig, store: Store, step: Step) -> None:
    """Let the report have a run as soon as it is done. A table may take days, and a store may be lost meanwhile."""
    if isinstance(step, Evaluate | Play):
        with _alone(config):
            before, run = _report_before(config) or blank(config), run_of(step, store)
            if kept_runs(before).get(run["recipe"], {}).get("digest") != run["digest"]:
                runs = {each["recipe"]: each for each in (*before.get("runs", []), run)}
                write_numbers(_document(config), {**before, "runs": list(runs.values())})


def _alone(config: BenchmarkConfig) -> FileLock:
    """Another command may write other parts of the same report."""
    document = _document(config)
    return FileLock(document.with_name(f".{document.name}.{LOCK}"))


def _report_before(config: BenchmarkConfig) -> Mapping[str, Any]:
    """The report that is there, to which tables are to be added; empty if there is none.

    Raises:
        ValueError: it is damaged, or of another benchmark.
    """
    path = numbers_file(_document(config))
    if not path.exists():
        return {}
    found = read_numbers(_document(config))
    ours = {"name": config.name, "tuning": config.tuning}
    if other := {key: found.get(key) for key, value in ours.items() if found.get(key) != value}:
        raise ValueError(f"{path} is the report of another benchmark: {other}; give another --document")
    return found


def _document(config: BenchmarkConfig) -> Path:
    return config.document or Path("outputs/benchmark") / config.name / config.name


def _submit(config: BenchmarkConfig) -> None:
    """Let jobs do the steps: they share the store, as commands on one machine do. The last one does what they left."""
    logs, alone = (
        log_folder(_document(config)),
        replace(config, executor="local", shards=1, slurm=SlurmConfig(), jobs=1),
    )
    array, last = submit_to_slurm(
        partial(_do_steps, alone), partial(benchmark_command, alone), "hdril_benchmark",
        config.shards, config.shards, config.slurm, logs,
    )  # fmt: skip
    print(f"Submitted {config.shards} jobs as job {array}; job {last} then makes {_document(config)}.md")
    print(f"Logs: {logs}; after a failure, the same command does what is missing")


def _do_steps(config: BenchmarkConfig, rank: int, world_size: int) -> None:
    store = Store(config.store)
    engine = Engine(store, config.jobs, lambda step, progress: _keep(config, store, step))
    _do(config, store, kept_runs(_report_before(config)), engine.run)


def _in_words(seconds: float) -> str:
    return f"{max(seconds / 60.0, 1.0):.0f} min" if seconds < 7200 else f"{seconds / 3600.0:.1f} h"


def _print_plan(config: BenchmarkConfig, store: Store, kept: Kept) -> None:
    """Each step: kept, in the report; done, and in what time; running, in this command or another; or left. And how long what is
    left may take."""
    ordered = in_order(_left(config, store, kept))
    rest = set(ordered)
    known = [step for step in in_order(all_steps(config.chosen)) if step not in rest]
    told = {step["recipe"]: step for run in kept.values() for step in (run, *run["made_from"].values())}
    progress = Progress.of([*known, *ordered], config.jobs)
    for step in known:
        print(f"kept    {step.kind:9} {step.title}")
        progress.settle(step, told[store.recipe(step)]["seconds"])
    count = len(known)
    for step in ordered:
        if done := store.find(step):
            count += 1
            progress.settle(step, done.seconds)
            print(f"done    {step.kind:9} {step.title} ({done.seconds:.0f} s)")
            continue
        place = store.place(step)
        running = place is not None and place.exists() and (is_busy(place) or is_running(place))
        print(f"{'running' if running else 'left':7} {step.kind:9} {step.title}")
    seconds = progress.remaining()
    rest = f"; about {_in_words(seconds)} are left" if seconds else ""
    print(f"{count} of {len(known) + len(ordered)} steps are done{rest}")


def main() -> None:
    """Entry point."""
    run("hdril-benchmark", BenchmarkConfig, benchmark_command)


if __name__ == "__main__":
    main()
