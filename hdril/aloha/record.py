"""python -m hdril.aloha.record: demonstrations of gym-aloha's tasks as a LeRobot dataset."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hdril.aloha.env import FPS, AlohaPosesEnv
from hdril.aloha.expert import demonstrate
from hdril.aloha.physics import require_extra
from hdril.aloha.tasks import AlohaTask, find_task
from hdril.cli.common import run
from hdril.cli.record import progress_bar
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.record import Selection, check_numbers, partial_folder, refuse_existing
from hdril.demonstrations.schema import features_of
from hdril.demonstrations.write import Layout, write_episodes
from hdril.files import naming


@dataclass(kw_only=True)
class AlohaRecordConfig:
    """Record demonstrations of ACT's scripted experts in gym-aloha, by poses, as a LeRobot dataset.

    Failures are dropped and counted. After Ctrl-C, nothing is left.
    """

    task: str = "transfer_cube"
    """transfer_cube or insertion."""
    num_episodes: int = 50
    """Successful episodes to record; ACT's datasets have 50."""
    seed: int = 1000
    """Seed of the first episode; the following ones count up. Evaluate on others, such as 500000 and up."""
    root: Path | None = None
    """Folder of the dataset; must not exist. Default: outputs/aloha/<task>."""


def record_command(config: AlohaRecordConfig) -> None:
    """Record, and say what was kept and dropped."""
    task = find_task(config.task)
    check_numbers(config.num_episodes, config.seed, workers=1)
    root = config.root or Path("outputs/aloha") / task.name
    refuse_existing(root)
    require_extra()
    with progress_bar(f"recording {task.name}", config.num_episodes) as progress:
        made = record(task, config.num_episodes, config.seed, root, progress)
    print(
        f"{len(made.kept)} episodes (seeds {made.kept[0]} to {made.kept[-1]}) in {root}, "
        f"{len(made.dropped)} of {len(made.kept) + len(made.dropped)} dropped"
    )
    for seed, why in made.dropped.items():
        print(f"  dropped seed {seed}: {why}")


def record(
    task: AlohaTask,
    num_episodes: int,
    first_seed: int,
    root: Path,
    progress: Callable[[int, int], None] | None = None,
) -> Selection:
    """Record ``num_episodes`` successful demonstrations at ``root``; seeds are tried in order from ``first_seed``.

    The dataset appears at ``root`` when it is whole. Returns which seeds were kept, and why which were dropped.

    Raises:
        FileExistsError: there is something at ``root``, or at ``<root>.partial``.
        MissingExtraError: gym-aloha is not installed.
        ExpertError: the expert fails more often than it succeeds.
    """
    staged = partial_folder(root)
    refuse_existing(root)
    refuse_existing(staged)
    env, selection, episodes = AlohaPosesEnv(task.name), Selection(num_episodes, progress), list[Episode]()
    while not selection.complete:
        episode = demonstrate(env, first_seed + len(selection.kept) + len(selection.dropped))
        selection.add(episode)
        if episode.success:
            episodes.append(episode)
    try:
        with naming(staged):
            write_episodes(
                staged, Layout(task.description, task.labels, features_of(task.state_names), "aloha", FPS), episodes
            )
            staged.replace(root)
    except BaseException:
        shutil.rmtree(staged, ignore_errors=True)
        raise
    return selection


def main() -> None:
    """Entry point."""
    run("python -m hdril.aloha.record", AlohaRecordConfig, record_command)


if __name__ == "__main__":
    main()
