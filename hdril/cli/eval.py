"""hdril-eval: any LeRobot policy on held-out seeds, compared with the expert."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from hdril.cli.common import check_repo_id, run
from hdril.cli.play import play_elsewhere, play_seeds
from hdril.cli.shards import PlayOptions, check_shards
from hdril.evaluation.checkpoint import resolve_config
from hdril.evaluation.evaluate import Job, make_job
from hdril.evaluation.held_out import HeldOut, check_held_out
from hdril.evaluation.journal import Journal
from hdril.evaluation.lerobot_actor import foreign_primitives
from hdril.evaluation.mishap import describe_mishap
from hdril.evaluation.observation import check_observation, observes_details
from hdril.evaluation.report import write_report
from hdril.evaluation.results import Comparison, Run, compare, headline
from hdril.evaluation.score import Outcome
from hdril.evaluation.stored import StoredEvaluation, read_evaluation
from hdril.evaluation.suite import check_suite
from hdril.execution import SlurmConfig
from hdril.files import MAX_SEED
from hdril.tasks import get_task
from hdril.viewer.keep import check_keep


@dataclass
class PolicySource:
    """Which policy. Any other --policy.NAME=VALUE changes its config for this evaluation, e.g. --policy.samples=5;
    an option that the policy does not have, or that its weights have fixed, is refused."""

    path: str
    """Checkpoint: a folder (…/checkpoints/last/pretrained_model) or a repository of the Hugging Face Hub (user/name)."""
    device: str = "cpu"
    """Device of the policy in every worker."""


@dataclass(kw_only=True)
class EvalConfig(PlayOptions):
    """Evaluate a LeRobot policy on held-out seeds: success with its 95 % interval, errors against the expert's
    demonstration of the same seed, a report, and Rerun recordings.

    After Ctrl-C, the same command goes on where it was. Results are of weights, not of a path: to go on, to compare and to
    publish, the weights, the config, the task, the seeds and the software must be those that made the results.
    """

    policy: PolicySource = field(kw_only=False)
    num_episodes: int = 100
    """Episodes, one a seed."""
    seed: int = 100_000
    """First seed. Seeds that the policy was trained on are refused."""
    max_frames: int | None = None
    """Frames after which an episode is cut; at least the task's horizon. By default that is its budget: the frames of the
    task's longest plan, or three times as many where scenes vary or something may happen (a mishap, too). With more, a
    policy that failed may try again."""
    mishap: str = ""
    """What spoils the policy's first grasp: its actions are changed until the expert's first grasp of the scene would be over.
    hands_stay, fingers_open, or hands_high (by 6 cm). Does the policy notice, and grasp again?"""
    training_data: Path | None = None
    """Folder of the dataset that the policy was trained on, if it is not found: to check that the seeds are held out. It
    must have the statistics that the checkpoint keeps. Checkpoints of hdril know their training data."""
    against: Path | None = None
    """Folder of a finished evaluation of another policy on the same task and seeds: the report compares the two, seed by
    seed."""
    rerun: str = "failures"
    """Episodes to keep as Rerun recordings: failures, all, none, or a number of episodes from the first on."""
    suite: str = ""
    """Name of a suite: the policy plays all its cells, each in a folder of its own, and one table compares them. factors: the
    nominal task, each factor alone, all factors (varied), each event alone, and all factors with an event (hard)."""
    cells: str = ""
    """Cells of the suite, separated by commas; all unless given. The nominal one and the controls come with them."""
    output_dir: Path | None = None
    """Folder of the results; must not exist. Default: outputs/eval/<task>_<time>."""
    push: str = ""
    """Publish results, and the checkpoint if it is a folder, in this model repository (user/name) of the Hugging Face Hub, and
    write them into its card. If output_dir holds this very evaluation already, it is published without playing anew."""
    private: bool = True
    """Whether a repository that --push makes is private."""


def _check(config: EvalConfig) -> None:
    get_task(config.task)
    if config.suite:
        check_suite(config.suite, config.task)
        if alone := [name for name in ("push", "max_frames", "mishap") if getattr(config, name)]:
            raise ValueError(
                f"{alone[0]} is an option of one evaluation, not of a suite: give the task of a cell instead"
            )
    elif config.cells:
        raise ValueError("cells are those of a suite: add --suite=factors")
    if config.push:
        check_repo_id("push", config.push)
        if config.mishap:
            raise ValueError("--push is for results that LeRobot can make again: leave out --mishap")
    check_shards(config, bool(config.push))
    if config.in_shards and config.executor != "ray" and config.output_dir is None:
        raise ValueError("shards need --output_dir: the command that goes on must find what they played")
    for name, least in (("num_episodes", 1), ("seed", 0), ("workers", 1)):
        if getattr(config, name) < least:
            raise ValueError(f"{name} must be at least {least}, got {getattr(config, name)}")
    if config.seed + config.num_episodes - 1 > MAX_SEED:
        raise ValueError(f"the last seed must be at most {MAX_SEED}, got {config.seed + config.num_episodes - 1}")
    check_keep("rerun", config.rerun)


def eval_command(config: EvalConfig, overrides: tuple[str, ...] = ()) -> None:
    """Evaluate, report, and publish if asked to. Nothing is written before everything is checked."""
    _check(config)
    output = config.output_dir or Path("outputs/eval") / f"{config.task}_{time.strftime('%Y-%m-%d_%H-%M-%S')}"
    if output.exists() and not config.push:
        raise FileExistsError(f"{output} exists; choose another output_dir or delete it")
    job = make_job(
        config.task, config.policy.path, config.seed, config.num_episodes, overrides=overrides,
        device=config.policy.device, max_frames=config.max_frames, mishap=config.mishap,
    )  # fmt: skip
    held_out = check_held_out(job.checkpoint, config.task, job.seeds, config.training_data)
    if not held_out.known:
        print(f"Note: whether these seeds are held out is not known: {held_out.basis}.")
    policy, task = resolve_config(job.checkpoint, overrides, config.policy.device), get_task(config.task)
    # A cluster's last job does what this command does on one machine. It has one processor.
    alone = replace(config, executor="local", slurm=SlurmConfig(), workers=1, output_dir=output.resolve())
    finish = partial(eval_command, alone, overrides)
    if config.suite:
        from hdril.cli.suite import evaluate_suite  # it evaluates each cell by what is defined here

        detailed = observes_details(policy, job.checkpoint.name, task)
        evaluate_suite(config, job, detailed, held_out, output, finish)
        return
    check_observation(policy, job.checkpoint.name, task)
    if output.exists():
        check_finished(read_evaluation(output), config, job)
    else:
        read_other(config.against, job)  # what cannot be compared is told before anything is played
        if play_elsewhere(config, config.rerun, {output: job}, output, finish):
            return
        start = time.monotonic()
        summary = evaluate_into(output, config, job, held_out)
        _announce(summary, output, time.monotonic() - start)
    if config.push:
        _push(config, job, output)


def describe(job: Job, held_out: HeldOut) -> Run:
    """What the report says of an evaluation, the results aside."""
    trials, task = job.identity.trials, get_task(job.task)
    notes = []
    if foreign := foreign_primitives(job.checkpoint, task):
        notes.append(f"Not of this task are the policy's primitives {', '.join(foreign)}: its planner is not scored.")
    if trials.mishap:
        notes.append(describe_mishap(trials.mishap))
    return Run(
        task=job.task,
        policy=job.checkpoint.name,
        overrides=job.overrides,
        first_seed=trials.first_seed,
        num_episodes=trials.num_episodes,
        held_out=held_out.known,
        held_out_basis=held_out.basis,
        max_frames=0 if trials.max_frames == task.budget else trials.max_frames,
        notes=tuple(notes),
        identity=job.identity.as_dict(),
        policy_folder=str(job.checkpoint.folder),
    )


def check_finished(evaluation: StoredEvaluation, config: EvalConfig, job: Job) -> None:
    """Raises ValueError unless a finished evaluation is the one that is asked for."""
    evaluation.require(job.identity)
    if (against := read_other(config.against, job)) is not None:
        evaluation.require_comparison(against)


def evaluate_into(
    output: Path, config: EvalConfig, job: Job, held_out: HeldOut, pool: Executor | None = None
) -> dict[str, Any]:
    """Evaluate a job, in ``pool`` if it is given, and write the report to ``output``; returns the data of ``results.json``."""
    against = read_other(config.against, job)
    journal = Journal(output, job.identity)
    with journal.writing() as add:
        play_seeds(job, job.seeds, journal, add, config.rerun, config.workers, pool)
        outcomes = sorted(journal.done.values(), key=lambda outcome: outcome.seed)
        summary = write_report(journal.folder, describe(job, held_out), outcomes, _compare(outcomes, against))
        journal.finish()
    return summary


def _announce(summary: Mapping[str, Any], output: Path, seconds: float) -> None:
    recordings = sorted((output / "rerun").glob("*.rrd")) if (output / "rerun").exists() else []
    print(f"{headline(summary)}; {seconds:.0f} s")
    print(f"Report: {output / 'report.md'}")
    if recordings:
        print(f"{len(recordings)} recordings: hdril-view --run={output}")


def read_other(folder: Path | None, job: Job) -> StoredEvaluation | None:
    """The evaluation to compare with. Raises ValueError unless it is of the same trials."""
    if folder is None:
        return None
    other = read_evaluation(folder)
    other.require_trials(job.identity.trials)
    return other


def _compare(outcomes: list[Outcome], against: StoredEvaluation | None) -> Comparison | None:
    return None if against is None else compare(against.results["policy"], outcomes, against.results)


def _push(config: EvalConfig, job: Job, output: Path) -> None:
    from hdril.hub.evaluations import publish_evaluation

    if config.output_dir is None:  # the default is another one each time
        print(f"Publishing {output}; should that fail, add --output_dir={output} to push it without playing anew")
    print(f"Published: {publish_evaluation(config.push, job, read_evaluation(output), config.private)}")


def split_overrides(arguments: list[str]) -> tuple[list[str], tuple[str, ...]]:
    """Options of this command, and those that belong to the policy's own config (with ``--policy.`` cut off)."""
    ours = ("--policy.path", "--policy.device")
    theirs = [a for a in arguments if a.startswith("--policy.") and a.split("=")[0] not in ours]
    return [a for a in arguments if a not in theirs], tuple("--" + a.removeprefix("--policy.") for a in theirs)


def main() -> None:
    """Entry point."""
    sys.argv[1:], overrides = split_overrides(sys.argv[1:])
    run("hdril-eval", EvalConfig, lambda config: eval_command(config, overrides))


if __name__ == "__main__":
    main()
