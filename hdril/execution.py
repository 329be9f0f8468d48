"""Work in shards on a Slurm or Ray cluster: one door to datatrove, which LeRobot uses for its large datasets, too.

A shard is a share of the work, by its number. Work must be the same whoever does it and in whatever order, and must not be done
again where its result is there: so shards may be killed and started anew.

On one machine, hdril has its own pool of processes (:mod:`hdril.workers`): datatrove's local executor waits forever for a
process that was killed.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hdril.errors import UserError
from hdril.workers import worker_pool

EXECUTORS = ("local", "slurm", "ray")

_RAY_MEMORY = 1
"""GB that a shard reserves."""

Work = Callable[[int, int], object]
"""Does shard i of n. Must be picklable."""


@dataclass
class SlurmConfig:
    """What Slurm is asked for."""

    partition: str = ""
    """Name of the partition; must be given."""
    time: str = "24:00:00"
    """Limit of a shard, as Slurm writes it."""
    mem_per_cpu_gb: int = 2
    """Memory of a shard, GB."""
    qos: str = ""
    """Quality of service; the cluster's own unless given."""
    account: str = ""
    """Account that is charged; the user's own unless given."""


def share[Item](items: Sequence[Item], shard: int, shards: int) -> Sequence[Item]:
    """The ``shard``-th of ``shards`` shares of a sequence: neighbours stay together, and sizes differ by one at most.

    Raises:
        ValueError: there is no such shard.
    """
    if not 0 <= shard < shards:
        raise ValueError(f"shard must be from 0 to {shards - 1}, got {shard}")
    return items[len(items) * shard // shards : len(items) * (shard + 1) // shards]


def check_execution(executor: str, shards: int, slurm: SlurmConfig) -> None:
    """Check that a cluster is there to be asked; nothing is written.

    Raises:
        ValueError: an unknown executor, or an option that is missing or out of range.
        UserError: what the executor needs is not installed.
    """
    if executor not in EXECUTORS:
        raise ValueError(f"executor must be {', '.join(EXECUTORS)}, got {executor!r}")
    if shards < 1:
        raise ValueError(f"shards must be at least 1, got {shards}")
    if executor == "slurm":
        if not slurm.partition:
            raise ValueError("--executor=slurm needs --slurm.partition: the name of a partition, as sinfo lists them")
        if shutil.which("sbatch") is None:
            raise UserError("--executor=slurm needs Slurm's sbatch, which is not on the PATH")
        if not _activate().exists():
            raise UserError(
                f"--executor=slurm needs {_activate()}, which its jobs source: "
                "start hdril from an environment that python -m venv or uv venv made"
            )
    if executor == "ray" and find_spec("ray") is None:
        raise UserError("--executor=ray needs Ray, the extra ray of hdril")


def run_on_ray(work: Work, shards: int, workers: int, folder: Path) -> None:
    """Do all shards on the Ray cluster that is there, or on one that is started here; returns when they are done.

    Args:
        work: see :data:`Work`.
        shards: how many there are.
        workers: at a time.
        folder: for logs, on a disk that all machines share.

    Raises:
        UserError: a shard failed; says where its log is.
    """
    import ray  # pyright: ignore[reportMissingImports]
    from datatrove.executor import RayPipelineExecutor

    _quiet()
    if not ray.is_initialized():
        ray.init(log_to_driver=False)
    shutil.rmtree(folder / "completions", ignore_errors=True)  # of an earlier run
    executor = RayPipelineExecutor(
        _pipeline(partial(_apart, work)), tasks=shards, workers=min(workers, shards), mem_per_cpu_gb=_RAY_MEMORY,
        logging_dir=str(folder.resolve()), skip_completed=False,
    )  # fmt: skip
    executor.run()
    if failed := executor.get_incomplete_ranks(skip_completed=True):
        raise UserError(f"{len(failed)} of {shards} shards failed, the first is {failed[0]}; their logs: {folder}/logs")


def submit_to_slurm(
    work: Work, finish: Callable[[], object], name: str, shards: int, workers: int, slurm: SlurmConfig, folder: Path
) -> tuple[str, str]:
    """Submit all shards as an array of jobs, and ``finish`` as a job that starts when the last shard has ended.

    ``finish`` must do what failed shards left.

    Args:
        work: see :data:`Work`.
        finish: picklable.
        name: of the jobs.
        shards: how many there are.
        workers: at a time.
        slurm: what the jobs may take.
        folder: for logs, on a disk that all machines share.

    Returns:
        The ids of both jobs.

    Raises:
        UserError: Slurm refused; says why.
        OSError: the folder of the logs cannot be written.
    """
    from datatrove.executor import SlurmPipelineExecutor

    _quiet()
    options: dict[str, Any] = {
        "partition": slurm.partition,
        "time": slurm.time,
        "mem_per_cpu_gb": slurm.mem_per_cpu_gb,
        "qos": slurm.qos,
        "venv_path": str(_activate()),
        "sbatch_args": {"kill-on-invalid-dep": "yes"} | ({"account": slurm.account} if slurm.account else {}),
    }

    def executor(pipeline: list[Any], part: str, **values: Any) -> SlurmPipelineExecutor:
        return SlurmPipelineExecutor(
            pipeline,
            job_name=f"{name}_{part}",
            logging_dir=str(folder.resolve() / part),
            skip_completed=False,
            **options,
            **values,
        )

    array = executor(_pipeline(work), "shards", tasks=shards, workers=workers)
    last = executor(
        _pipeline(partial(_finish, finish)), "finish", tasks=1, depends=array, run_on_dependency_fail=True,
    )  # fmt: skip
    try:
        last.run()
    except subprocess.CalledProcessError as error:
        raise UserError(f"Slurm refused the jobs: {error}") from error
    return str(array.job_id), str(last.job_id)


def _activate() -> Path:
    """What makes this environment that of a shell; datatrove's jobs begin with it."""
    return Path(sys.prefix) / "bin" / "activate"


def _quiet() -> None:
    """Keep datatrove's messages out of this process's output; shards log to their files."""
    from loguru import logger

    logger.disable("datatrove")


def _pipeline(work: Work) -> list[Any]:
    return [partial(_step, work)]


def _step(work: Work, data: object, rank: int, world_size: int) -> None:
    """A step of a datatrove pipeline: no data goes through it."""
    work(rank, world_size)


def _apart(work: Work, rank: int, world_size: int) -> None:
    """Work in a process of its own: where that is killed, the shard fails. datatrove's pool on Ray would wait for it forever."""
    with worker_pool(1) as pool:
        pool.submit(work, rank, world_size).result()


def _finish(finish: Callable[[], object], rank: int, world_size: int) -> None:
    finish()
