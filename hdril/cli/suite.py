"""``hdril-eval --suite``: one policy on all cells of a suite. Each cell is an ordinary evaluation in a folder of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from hdril.cli.eval import EvalConfig, check_finished, evaluate_into, read_other
from hdril.cli.play import play_elsewhere
from hdril.evaluation.evaluate import Job
from hdril.evaluation.held_out import HeldOut
from hdril.evaluation.identity import Identity, identify_trials
from hdril.evaluation.results import headline
from hdril.evaluation.stored import read_evaluation
from hdril.evaluation.suite import SUITES, Cell, choose
from hdril.evaluation.suite_report import write_suite
from hdril.evaluation.suite_table import tabulate_suite
from hdril.evaluation.unfinished import UnfinishedFolder
from hdril.workers import worker_pool


def evaluate_suite(
    config: EvalConfig,
    nominal: Job,
    detailed: bool,
    held_out: HeldOut,
    output: Path,
    finish: Callable[[], object],
) -> None:
    """Evaluate all cells, one after the other, and write the table.

    Args:
        config: what was asked for.
        nominal: the policy on the task as it was given.
        detailed: whether the policy is shown all that may vary.
        held_out: what is known of the seeds, which all cells share.
        output: the folder of the suite.
        finish: what ends the suite when its shards are played by jobs that outlive this process.
    """
    names = [name for name in config.cells.split(",") if name]
    cells = choose(SUITES[config.suite](config.task, detailed), names)
    # Shards may run in other folders than this command.
    unfinished = UnfinishedFolder(output.resolve(), "suite", "suite_run.json", _identity(config, nominal, cells))
    jobs = {unfinished.folder / cell.name: _job(nominal, cell) for cell in cells}
    for folder, job in jobs.items():
        read_other(_against(config, folder.name), job)  # what cannot be compared is told before anything is played
    if play_elsewhere(config, config.rerun, jobs, output, finish, unfinished.begin_share):
        return
    start = time.monotonic()
    with unfinished.writing(), _pool(min(config.workers, config.num_episodes)) as pool:
        results = {}
        for number, (cell, (folder, job)) in enumerate(zip(cells, jobs.items(), strict=True), 1):
            results[cell.name] = _evaluate_cell(folder, config, job, held_out, pool)
            print(f"[{number}/{len(cells)}] {cell.name}: {headline(results[cell.name])}", flush=True)
        write_suite(unfinished.folder, tabulate_suite(config.suite, config.task, cells, results))
        unfinished.finish()
    print(f"Table: {output / 'suite.md'}; {time.monotonic() - start:.0f} s")


def _job(nominal: Job, cell: Cell) -> Job:
    """The same policy in a cell."""
    first, count = nominal.identity.trials.first_seed, nominal.identity.trials.num_episodes
    trials = identify_trials(cell.task, first, count, cell.max_frames)
    return replace(nominal, task=cell.task, identity=Identity(nominal.identity.policy, trials))


def _identity(config: EvalConfig, nominal: Job, cells: Sequence[Cell]) -> dict[str, Any]:
    """What the suite is of; the trials of its cells are guarded by the cells."""
    trials = {"task": config.task, "first_seed": config.seed, "num_episodes": config.num_episodes}
    names = ", ".join(cell.name for cell in cells)
    return {"policy": asdict(nominal.identity.policy), "trials": trials, "suite": config.suite, "cells": names}


@contextmanager
def _pool(workers: int) -> Iterator[Executor | None]:
    """One pool for all cells: a process takes seconds to import what a policy needs."""
    if workers == 1:
        yield None
        return
    with worker_pool(workers) as pool:
        yield pool


def _against(config: EvalConfig, cell: str) -> Path | None:
    """The other policy's folder of a cell."""
    return None if config.against is None else config.against / cell


def _evaluate_cell(
    output: Path, config: EvalConfig, job: Job, held_out: HeldOut, pool: Executor | None
) -> dict[str, Any]:
    """The results of a cell, from before if it is finished."""
    config = replace(config, against=_against(config, output.name))
    if not output.exists():
        return evaluate_into(output, config, job, held_out, pool)
    finished = read_evaluation(output)
    check_finished(finished, config, job)
    return finished.results
