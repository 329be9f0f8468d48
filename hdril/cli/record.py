"""hdril-record: scripted demonstrations as a LeRobot dataset."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from hdril.cli.common import run
from hdril.primitives import Noise
from hdril.recording import Recipe, record


@dataclass
class RecordConfig:
    """Record demonstrations of the scripted expert as a LeRobot dataset. Failures are dropped and counted.

    After Ctrl-C, the same command goes on where it was.
    """

    repo_id: str
    """Name of the dataset, as user/name."""
    task: str = "table_lift"
    """Name of the task, with its parameters if it has any (peg_in_hole:clearance=0.004); an unknown one is answered with
    those there are."""
    num_episodes: int = 100
    """Successful episodes to record."""
    seed: int = 0
    """Seed of the first episode; the following ones count up. Evaluation uses other seeds (100000 and up)."""
    root: Path | None = None
    """Folder of the dataset; must not exist. Default: LeRobot's home, under repo_id."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Processes that simulate. The dataset is the same for any number."""
    noise: Noise = field(default_factory=Noise)
    """Noise of the demonstrations."""


def record_command(config: RecordConfig) -> None:
    if config.repo_id.count("/") != 1:
        raise ValueError(f"repo_id must look like user/name, got {config.repo_id!r}")
    recipe = Recipe(config.task, config.noise)
    root = config.root or _default_root(config.repo_id)
    start = time.monotonic()
    with tqdm(total=max(config.num_episodes, 0), desc=f"recording {config.task}", unit="episode") as bar:

        def progress(kept: int, dropped: int) -> None:
            bar.set_postfix(dropped=dropped, refresh=False)
            bar.update(kept - bar.n)

        try:
            recording = record(recipe, config.num_episodes, config.seed, config.repo_id, root, config.workers, progress)
        except KeyboardInterrupt:
            bar.close()
            print(f"\nStopped; nothing was written to {root}. Run the same command again to go on.")
            raise
    tried = len(recording.seeds) + len(recording.dropped)
    print(
        f"{len(recording.seeds)} episodes (seeds {recording.seeds[0]} to {recording.seeds[-1]}) in {recording.root}, "
        f"{len(recording.dropped)} of {tried} dropped, {time.monotonic() - start:.0f} s"
    )
    for seed, why in recording.dropped.items():
        print(f"  dropped seed {seed}: {why}")


def _default_root(repo_id: str) -> Path:
    from lerobot.utils.constants import HF_LEROBOT_HOME

    return HF_LEROBOT_HOME / repo_id


def main() -> None:
    """Entry point."""
    run("hdril-record", RecordConfig, record_command)


if __name__ == "__main__":
    main()
