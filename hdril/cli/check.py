"""hdril-check: is a dataset what it says?"""

from __future__ import annotations

import os
import sys
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from hdril.cli.common import run
from hdril.demonstrations.check import check_dataset

ALL = "all"


@dataclass
class CheckConfig:
    """Check a LeRobot dataset of states whose primitives are labelled in subtask_index: hdril-check DATASET, then options.

    Schema, numbering, finite numbers, unit quaternions, openings, reach, labels, success, and where hdril recorded it, digests.
    Says what is wrong, in which episode and at which frame. The exit code is 0 if nothing is, 1 if something is.
    """

    dataset: Path
    """Folder of the dataset; --dataset= may be left out."""
    remake: str = "0"
    """How many episodes to make again from recipe and seed and to compare number for number, or all. Only on the kind of
    machine that recorded them are the numbers the same."""
    show: int = 20
    """How many findings to print; the others are counted."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Processes that make episodes again."""


def check_command(config: CheckConfig) -> None:
    """Print what is wrong, and exit with 1 if anything is."""
    if config.remake != ALL and not config.remake.isdecimal():
        raise ValueError(f"remake must be a number of episodes or {ALL}, got {config.remake!r}")
    for name in ("show", "workers"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name} must be at least 1, got {getattr(config, name)}")
    wanted = None if config.remake == ALL else int(config.remake)
    if found := report(config.dataset, wanted, config.workers, config.show):
        print(f"{config.dataset}: {found} finding{'s' if found > 1 else ''}")
        sys.exit(1)
    print(f"{config.dataset}: nothing is wrong")


def report(dataset: Path, made_again: int | None, workers: int, show: int) -> int:
    """Print the first ``show`` findings, and return how many there are."""
    count, stage = 0, ""
    with tqdm(unit="episode") as bar:

        def progress(doing: str, done: int, total: int) -> None:
            nonlocal stage
            if doing != stage:
                stage = doing
                bar.reset(total)
                bar.set_description(doing)
            bar.update(done - bar.n)

        with closing(check_dataset(dataset, made_again, workers, progress)) as findings:
            for finding in findings:
                count += 1
                if count <= show:
                    bar.write(str(finding))
    if count > show:
        print(f"… and {count - show} more; --show={count} prints all")
    return count


def main() -> None:
    """Entry point."""
    run("hdril-check", CheckConfig, check_command, positional="dataset")


if __name__ == "__main__":
    main()
