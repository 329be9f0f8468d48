"""hdril-record: scripted demonstrations as a LeRobot dataset."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hdril import __version__
from hdril.cli.check import CheckConfig, check_command
from hdril.cli.common import check_repo_id, run
from hdril.cli.shards import PlayOptions, check_shards, log_folder
from hdril.demonstrations.labels import FORMS, NUMBERS, WORDS, check_forms, forms_of
from hdril.demonstrations.provenance import Recipe, read_provenance
from hdril.demonstrations.record import check_numbers, partial_folder, record, record_shard, refuse_existing
from hdril.demonstrations.shards import check_unfinished
from hdril.execution import run_on_ray, submit_to_slurm
from hdril.tasks import ANY_EVENT, TASKS, base_name
from hdril.tasks.primitives import Noise


@dataclass(kw_only=True)
class RecordConfig(PlayOptions):
    """Record demonstrations of the scripted expert as a LeRobot dataset. Failures are dropped and counted.

    After Ctrl-C, the same command goes on where it was.
    """

    repo_id: str | None = None
    """Name of the dataset on the Hugging Face Hub, as user/name. Only --push needs it: a dataset that stays here has no name,
    and --dataset.repo_id of LeRobot's commands may be any beside --dataset.root."""
    events: str = ""
    """What happens to the demonstrations: names of the task's events with their probability in an episode
    (push=0.3,open_hand=0.2), any_event=0.5 for one of all. The expert mends what it can, and what it cannot is dropped."""
    perturb: float = 0.0
    """Standard deviation, m, of noise that the robot gets at every frame and the recorded action does not."""
    stray: float = 0.0
    """Standard deviation, m, of places beside its way to which a hand is sent now and then, for about a second; the recorded
    action is what was meant. Grasps miss by it, and the expert shows how that is mended."""
    num_episodes: int = 100
    """Successful episodes to record."""
    seed: int = 0
    """Seed of the first episode; the following ones count up. Evaluation uses other seeds (100000 and up)."""
    root: Path | None = None
    """Folder of the dataset; must not exist. Default: LeRobot's home under repo_id if that is given, else
    outputs/<task>/dataset."""
    labels: str = NUMBERS
    """Forms of the primitives' labels, separated by commas. subtask_index must be there. language adds LeRobot's column
    language_persistent, which some viewers cannot read."""
    noise: Noise = field(default_factory=Noise)
    """Noise of the demonstrations."""
    verify: Path | None = None
    """Record nothing: make num_episodes episodes of the dataset in this folder again, spread over it (all if it has no more),
    compare them number for number, and check the rest as hdril-check does."""
    push: bool = False
    """Publish the dataset on the Hugging Face Hub under repo_id, with a card. If it is at root already and is what these
    options make, it is published without recording anew."""
    private: bool = True
    """Whether a repository that --push makes is private."""


def record_command(config: RecordConfig) -> None:
    """Record, and publish if asked to; or verify what is recorded."""
    if config.verify is not None:
        _verify(config.verify, config)
        return
    if config.repo_id is not None:
        check_repo_id("repo_id", config.repo_id)
    elif config.push:
        raise ValueError("--push needs --repo_id: the name of the dataset on the Hub, as user/name")
    if NUMBERS not in check_forms(config.labels):
        raise ValueError(f"labels must have {NUMBERS}; it may have {WORDS} beside it, got {config.labels!r}")
    check_shards(config, config.push)
    recipe = Recipe(with_events(config.task, config.events), config.noise, perturb=config.perturb, stray=config.stray)
    root = config.root or default_root(recipe.task, config.repo_id)
    if config.push and root.exists():
        _check_same(root, recipe, config)
    elif config.shard is not None:
        _record_shard(recipe, config, root)
        return
    elif config.executor == "slurm":
        _submit(recipe, config, root)
        return
    else:
        if config.executor == "ray":
            _record_on_ray(recipe, config, root)
        _record(recipe, config, root)
    if config.push and config.repo_id is not None:
        _push(config.repo_id, config, root)


def with_events(task: str, events: str) -> str:
    """The task's name with the probabilities of ``events`` among its parameters.

    Raises:
        ValueError: something that is no event of the task; names those there are.
    """
    if not events:
        return task
    base = base_name(task)
    known = (*(event.name for event in TASKS.find(base).events), ANY_EVENT)
    for item in events.split(","):
        name = item.partition("=")[0]
        if name not in known or known == (ANY_EVENT,):
            has = ", ".join(known) if len(known) > 1 else "none"
            raise ValueError(f"{base} has no event {name!r}; it has: {has}")
    return f"{task}{',' if ':' in task else ':'}{events}"


def default_root(task: str, repo_id: str | None) -> Path:
    """Where a dataset goes unless the user says where: where LeRobot looks for ``repo_id``, or beside the task's policies."""
    if repo_id is None:
        return Path("outputs") / re.sub(r"[^\w.-]+", "_", task) / "dataset"
    from lerobot.utils.constants import HF_LEROBOT_HOME

    return HF_LEROBOT_HOME / repo_id


def _record_shard(recipe: Recipe, config: RecordConfig, root: Path) -> None:
    shard, shards = config.shard or 0, config.shards
    with progress_bar(f"recording {config.task}, shard {shard}", config.num_episodes // shards) as progress:
        record_shard(recipe, config.num_episodes, config.seed, root, shard, shards, config.workers, progress)
    print(f"Shard {shard} of {shards} is in {partial_folder(root)}; the same command without --shard makes the dataset")


def _shares(recipe: Recipe, config: RecordConfig, root: Path) -> Callable[[int, int], None]:
    """What a cluster does, checked as far as it can be here."""
    check_numbers(config.num_episodes, config.seed, config.workers)
    refuse_existing(root)
    check_unfinished(partial_folder(root), recipe, config.seed)
    return partial(record_shard, recipe, config.num_episodes, config.seed, root.resolve())


def _record_on_ray(recipe: Recipe, config: RecordConfig, root: Path) -> None:
    run_on_ray(_shares(recipe, config, root), config.shards, config.workers, log_folder(root))


def _submit(recipe: Recipe, config: RecordConfig, root: Path) -> None:
    work = _shares(recipe, config, root)
    finish = partial(record, recipe, config.num_episodes, config.seed, root.resolve(), words=_in_words(config))
    array, last = submit_to_slurm(
        work, finish, "hdril_record", config.shards, config.workers, config.slurm, log_folder(root)
    )
    print(f"Submitted {config.shards} shards as job {array}; job {last} then makes {root}")
    print(f"Logs: {log_folder(root)}; after a failure, the same command plays what is missing")


def _in_words(config: RecordConfig) -> bool:
    return WORDS in check_forms(config.labels)


@contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[[int, int], None]]:
    """Gives a function that shows the numbers of kept and dropped episodes."""
    with tqdm(total=max(total, 0), desc=title, unit="episode") as bar:

        def progress(kept: int, dropped: int) -> None:
            bar.set_postfix(dropped=dropped, refresh=False)
            bar.update(kept - bar.n)

        yield progress


def _record(recipe: Recipe, config: RecordConfig, root: Path) -> None:
    start = time.monotonic()
    try:
        with progress_bar(f"recording {config.task}", config.num_episodes) as progress:
            made = record(recipe, config.num_episodes, config.seed, root, config.workers, progress, _in_words(config))
    except KeyboardInterrupt:
        print(f"\nStopped; nothing was written to {root}. Run the same command again to go on.")
        raise
    tried = len(made.seeds) + len(made.dropped)
    print(
        f"{len(made.seeds)} episodes (seeds {made.seeds[0]} to {made.seeds[-1]}) in {root}, "
        f"{len(made.dropped)} of {tried} dropped, {time.monotonic() - start:.0f} s"
    )
    for seed, why in made.dropped.items():
        print(f"  dropped seed {seed}: {why}")


def _verify(dataset: Path, config: RecordConfig) -> None:
    acting = ("verify", "num_episodes", "workers")
    if idle := [option.name for option in fields(config) if option.name not in acting and _is_given(config, option)]:
        raise ValueError(f"--verify records nothing: leave out {', '.join(idle)}")
    check_numbers(config.num_episodes, 0, config.workers)
    check_command(CheckConfig(dataset, str(config.num_episodes), workers=config.workers))


def _is_given(config: RecordConfig, option: Field[Any]) -> bool:
    default = option.default if option.default_factory is MISSING else option.default_factory()
    return getattr(config, option.name) != default


def _check_same(root: Path, recipe: Recipe, config: RecordConfig) -> None:
    """Raises FileExistsError unless the dataset at ``root`` is what this hdril makes of the options."""
    provenance = read_provenance(root)
    asked = (recipe, config.num_episodes, config.seed)
    if provenance is None or asked != (provenance.recipe, len(provenance.seeds), provenance.first_seed):
        raise FileExistsError(f"{root} exists and holds something else; choose another root or delete it")
    if provenance.hdril_version != __version__:
        raise FileExistsError(
            f"{root} exists and was recorded by hdril {provenance.hdril_version}, not by {__version__}; "
            "choose another root or delete it"
        )
    if (there := forms_of(root)) != tuple(form for form in FORMS if form in check_forms(config.labels)):
        raise FileExistsError(
            f"{root} exists and has labels in {' and '.join(there) or 'no form'}, not in {config.labels}; "
            f"give --labels={','.join(there)}, or choose another root"
        )


def _push(repo_id: str, config: RecordConfig, root: Path) -> None:
    from hdril.hub.cards import dataset_card
    from hdril.hub.publish import publish

    files: dict[str, Path | bytes] = {
        str(path.relative_to(root)): path
        for folder in ("data", "meta")
        for path in sorted((root / folder).rglob("*.*"))
    }
    files["README.md"] = dataset_card(repo_id, root).encode()
    # LeRobot finds the version of a dataset's format by this tag.
    tag = json.loads((root / "meta/info.json").read_text())["codebase_version"]
    message = f"{config.num_episodes} episodes of {config.task}"
    print(f"Published: {publish(repo_id, 'dataset', files, message, config.private, tag)}")


def main() -> None:
    """Entry point."""
    run("hdril-record", RecordConfig, record_command)


if __name__ == "__main__":
    main()
