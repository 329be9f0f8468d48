"""Episodes of an evaluation, played here or in shards. What is played goes into journals, which the evaluation then reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from functools import partial
from pathlib import Path

from tqdm import tqdm

from hdril.cli.shards import PlayOptions, log_folder
from hdril.evaluation.evaluate import Job, evaluate
from hdril.evaluation.journal import Journal
from hdril.evaluation.score import Outcome
from hdril.execution import run_on_ray, share, submit_to_slurm
from hdril.viewer.recordings import RecordingWriter


def play_seeds(
    job: Job,
    seeds: Sequence[int],
    journal: Journal,
    add: Callable[[Outcome], None],
    keep: str,
    workers: int,
    pool: Executor | None = None,
) -> None:
    """Play those of ``seeds`` that the journal does not have, adding them as they come.

    Args:
        job: what is evaluated.
        seeds: of its trials.
        journal: where the outcomes are.
        add: adds one.
        keep: which episodes to keep as recordings.
        workers: processes, unless ``pool`` is given.
        pool: of processes.
    """
    left = [seed for seed in seeds if seed not in journal.done]
    if not left:
        return
    first = job.identity.trials.first_seed
    writer = RecordingWriter(journal.folder / "rerun", keep, first) if keep != "none" else None
    with (
        tqdm(total=len(seeds), initial=len(seeds) - len(left), desc=f"evaluating {job.task}", unit="episode") as bar,
        closing(evaluate(job, left, min(workers, len(left)), writer, pool)) as stream,
    ):
        for outcome in stream:
            add(outcome)
            successes = sum(entry.success for entry in journal.done.values())
            bar.set_postfix(success=f"{100 * successes / len(journal.done):.1f}%", refresh=False)
            bar.update()


def play_share(
    jobs: Mapping[Path, Job],
    keep: str,
    begin: Callable[[], object] | None,
    shard: int,
    shards: int,
    workers: int = 1,
) -> None:
    """Play one share of the seeds of every job, for the evaluation in the job's folder, which finds what was played.

    ``begin`` is called first, if there is one.

    Raises:
        ValueError: there is no such shard; the checkpoint is not what it was; the folder holds something else.
        BusyError: another process plays this share.
    """
    if begin is not None:
        begin()
    for folder, job in jobs.items():
        if folder.exists():  # a cell of a suite that is finished
            continue
        seeds, journal = share(job.seeds, shard, shards), Journal(folder, job.identity)
        with journal.sharing(shard, shards) as add:
            play_seeds(job, seeds, journal, add, keep, workers)


def play_elsewhere(
    options: PlayOptions,
    keep: str,
    jobs: Mapping[Path, Job],
    output: Path,
    finish: Callable[[], object],
    begin: Callable[[], object] | None = None,
) -> bool:
    """Let shards be played, if ``options`` ask for it.

    Args:
        options: who plays what.
        keep: which episodes to keep as recordings.
        jobs: what is evaluated, by the folder of each.
        output: the folder of all results.
        finish: picklable; plays what is missing and reports.
        begin: picklable; what each shard does first.

    Returns:
        Whether there is nothing more to do here: one shard was played, or jobs were submitted.

    Raises:
        ValueError, FileExistsError: a folder holds something else; nothing is written.
    """
    if options.in_shards:
        for folder, job in jobs.items():
            if not folder.exists():
                Journal(folder, job.identity)
    jobs = {folder.resolve(): job for folder, job in jobs.items()}
    if options.shard is not None:
        play_share(jobs, keep, begin, options.shard, options.shards, options.workers)
        print(f"Shard {options.shard} of {options.shards} is played; the same command without --shard makes the report")
        return True
    work, logs = partial(play_share, jobs, keep, begin), log_folder(output)
    if options.executor == "slurm":
        array, last = submit_to_slurm(work, finish, "hdril_eval", options.shards, options.workers, options.slurm, logs)
        print(f"Submitted {options.shards} shards as job {array}; job {last} then makes {output}")
        print(f"Logs: {logs}; after a failure, the same command plays what is missing")
        return True
    if options.executor == "ray":
        run_on_ray(work, options.shards, options.workers, logs)
    return False
