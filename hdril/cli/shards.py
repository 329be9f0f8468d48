"""What the commands that play seeds have in common: which seeds of which task, and who plays them."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from hdril.execution import SlurmConfig, check_execution


@dataclass(kw_only=True)
class PlayOptions:
    """Seeds of a task, and who plays them."""

    task: str = "table_lift"
    """Name of the task, with its parameters if it has any (peg_in_hole:clearance=0.004, table_lift:level=varied); an unknown one
    is answered with those there are."""
    num_episodes: int = 100
    """Episodes."""
    seed: int = 0
    """First seed; the following ones count up."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Processes. The result is the same for any number."""
    shards: int = 1
    """Shares of the seeds that are played apart: by executor, or one by one with shard. They do not change the result."""
    shard: int | None = None
    """Play this share of the seeds alone, from 0 to shards - 1, and end. The same command without it plays what is missing and
    finishes: for clusters that hdril does not know. The disk must be shared."""
    executor: str = "local"
    """Who plays the shards: local, this machine; slurm, jobs of a Slurm cluster, and this command ends when they are
    submitted; ray, a Ray cluster. On a cluster, workers is how many shards play at once."""
    slurm: SlurmConfig = field(default_factory=SlurmConfig)
    """What the jobs of --executor=slurm may take."""

    @property
    def in_shards(self) -> bool:
        """Whether shards are to be played apart, before the result is made of them or instead."""
        return self.shard is not None or self.executor != "local"


def check_shards(options: PlayOptions, push: bool) -> None:
    """Check the options; nothing is written.

    Args:
        options: what was given.
        push: whether the result is to be published.

    Raises:
        ValueError: an option is out of range, or acts on nothing beside the others.
        UserError: what the executor needs is not installed.
    """
    if options.shard is not None and options.executor != "local":
        raise ValueError(f"--shard plays here: leave out --executor={options.executor}")
    check_execution(options.executor, options.shards, options.slurm)
    if options.shard is not None and not 0 <= options.shard < options.shards:
        raise ValueError(f"shard must be from 0 to {options.shards - 1}, got {options.shard}")
    if options.executor != "slurm" and options.slurm != SlurmConfig():
        raise ValueError("--slurm.* is for --executor=slurm")
    if push and (options.shard is not None or options.executor == "slurm"):
        raise ValueError("--push comes when all is there: give it without --shard and --executor=slurm")


def log_folder(result: Path) -> Path:
    """Where a cluster's logs go: beside the result, because what is in the unfinished one is removed when it is whole."""
    return result.with_name(result.name + ".jobs")
