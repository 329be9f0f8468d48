"""hdril-record: scripted demonstrations as a LeRobot dataset."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from hdril.cli.common import run
from hdril.demonstrations.provenance import Recipe, read_provenance
from hdril.demonstrations.record import record
from hdril.tasks.primitives import Noise


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
    push: bool = False
    """Publish the dataset on the Hugging Face Hub under repo_id, with a card. If it is at root already and is what these
    options make, it is published without recording anew."""
    private: bool = True
    """Whether a repository that --push makes is private."""


def record_command(config: RecordConfig) -> None:
    if config.repo_id.count("/") != 1:
        raise ValueError(f"repo_id must look like user/name, got {config.repo_id!r}")
    recipe = Recipe(config.task, config.noise)
    root = config.root or _default_root(config.repo_id)
    if config.push and root.exists():
        _check_same(root, recipe, config)
        _push(config, root)
        return
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
    if config.push:
        _push(config, root)


def _check_same(root: Path, recipe: Recipe, config: RecordConfig) -> None:
    """Raises FileExistsError unless the dataset at ``root`` is what the options ask for."""
    provenance = read_provenance(root)
    asked = (recipe, config.num_episodes, config.seed)
    if provenance is None or asked != (provenance.recipe, len(provenance.seeds), min(provenance.seeds)):
        raise FileExistsError(f"{root} exists and holds something else; choose another root or delete it")


def _push(config: RecordConfig, root: Path) -> None:
    from hdril.hub.cards import dataset_card
    from hdril.hub.publish import publish

    files: dict[str, Path | bytes] = {
        str(path.relative_to(root)): path
        for folder in ("data", "meta")
        for path in sorted((root / folder).rglob("*.*"))
    }
    files["README.md"] = dataset_card(config.repo_id, root).encode()
    # LeRobot finds the version of a dataset's format by this tag.
    tag = json.loads((root / "meta/info.json").read_text())["codebase_version"]
    message = f"{config.num_episodes} episodes of {config.task}"
    print(f"Published: {publish(config.repo_id, 'dataset', files, message, config.private, tag)}")


def _default_root(repo_id: str) -> Path:
    from lerobot.utils.constants import HF_LEROBOT_HOME

    return HF_LEROBOT_HOME / repo_id


def main() -> None:
    """Entry point."""
    run("hdril-record", RecordConfig, record_command)


if __name__ == "__main__":
    main()
