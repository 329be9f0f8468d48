"""hdril-eval: any LeRobot policy on held-out seeds, compared with the expert."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hdril.cli.common import check_repo_id, run
from hdril.evaluation.checkpoint import resolve_config
from hdril.evaluation.evaluate import Job, evaluate, make_job
from hdril.evaluation.held_out import HeldOut, check_held_out
from hdril.evaluation.journal import Journal
from hdril.evaluation.lerobot_actor import foreign_primitives
from hdril.evaluation.observation import check_observation, observes_details
from hdril.evaluation.report import write_report
from hdril.evaluation.results import Comparison, Run, compare, headline
from hdril.evaluation.score import Outcome
from hdril.evaluation.stored import StoredEvaluation, read_evaluation
from hdril.evaluation.suite import check_suite
from hdril.files import MAX_SEED
from hdril.tasks import get_task
from hdril.viewer.keep import check_keep
from hdril.viewer.recordings import RecordingWriter


@dataclass
class PolicySource:
    """Which policy. Any other --policy.NAME=VALUE changes its config for this evaluation, e.g. --policy.rollout=open_loop;
    an option that the policy does not have, or that its weights have fixed, is refused."""

    path: str
    """Checkpoint: a folder (…/checkpoints/last/pretrained_model) or a repository of the Hugging Face Hub (user/name)."""
    device: str = "cpu"
    """Device of the policy in every worker."""


@dataclass
class EvalConfig:
    """Evaluate a LeRobot policy on held-out seeds: success with its 95 % interval, errors against the expert's
    demonstration of the same seed, a report, and Rerun recordings.

    After Ctrl-C, the same command goes on where it was. Results are of weights, not of a path: to go on, to compare and to
    publish, the weights, the config, the task, the seeds and the software must be those that made the results.
    """

    policy: PolicySource
    task: str = "table_lift"
    """Name of the task, with its parameters if it has any (peg_in_hole:clearance=0.004); an unknown one is answered with
    those there are."""
    num_episodes: int = 100
    """Episodes, one a seed."""
    seed: int = 100_000
    """First seed. Seeds that the policy was trained on are refused."""
    max_frames: int | None = None
    """Frames after which an episode is cut; at least the task's horizon. By default that is its budget: the frames of the
    task's longest plan, or three times as many where scenes vary or something may happen. With more, a policy that failed
    may try again."""
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
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Processes. The outcomes are the same for any number."""
    push: str = ""
    """Publish results, and the checkpoint if it is a folder, in this model repository (user/name) of the Hugging Face Hub, and
    write them into its card. If output_dir holds this very evaluation already, it is published without playing anew."""
    private: bool = True
    """Whether a repository that --push makes is private."""


def _check(config: EvalConfig) -> None:
    get_task(config.task)
    if config.suite:
        check_suite(config.suite, config.task)
        if alone := [name for name in ("push", "max_frames") if getattr(config, name)]:
            raise ValueError(
                f"{alone[0]} is an option of one evaluation, not of a suite: give the task of a cell instead"
            )
    elif config.cells:
        raise ValueError("cells are those of a suite: add --suite=factors")
    if config.push:
        check_repo_id("push", config.push)
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
        device=config.policy.device, max_frames=config.max_frames,
    )  # fmt: skip
    held_out = check_held_out(job.checkpoint, config.task, job.seeds, config.training_data)
    if not held_out.known:
        print(f"Note: whether these seeds are held out is not known: {held_out.basis}.")
    policy, task = resolve_config(job.checkpoint, overrides, config.policy.device), get_task(config.task)
    if config.suite:
        from hdril.cli.suite import evaluate_suite  # it evaluates each cell by what is defined here

        evaluate_suite(config, job, observes_details(policy, job.checkpoint.name, task), held_out, output)
        return
    check_observation(policy, job.checkpoint.name, task)
    if output.exists():
        check_finished(read_evaluation(output), config, job)
    else:
        start = time.monotonic()
        summary = evaluate_into(output, config, job, held_out)
        _announce(summary, output, time.monotonic() - start)
    if config.push:
        _push(config, job, output)


def describe(job: Job, held_out: HeldOut) -> Run:
    """What the report says of an evaluation, the results aside."""
    trials, task = job.identity.trials, get_task(job.task)
    foreign = foreign_primitives(job.checkpoint, task)
    note = f"Not of this task are the policy's primitives {', '.join(foreign)}: its planner is not scored."
    return Run(
        task=job.task,
        policy=job.checkpoint.name,
        overrides=job.overrides,
        first_seed=trials.first_seed,
        num_episodes=trials.num_episodes,
        held_out=held_out.known,
        held_out_basis=held_out.basis,
        max_frames=0 if trials.max_frames == task.budget else trials.max_frames,
        notes=(note,) if foreign else (),
        identity=job.identity.as_dict(),
        policy_folder=str(job.checkpoint.folder),
    )


def check_finished(evaluation: StoredEvaluation, config: EvalConfig, job: Job) -> None:
    """Raises ValueError unless a finished evaluation is the one that is asked for."""
    evaluation.require(job.identity)
    if (against := _read_other(config.against, job)) is not None:
        evaluation.require_comparison(against)


def evaluate_into(
    output: Path, config: EvalConfig, job: Job, held_out: HeldOut, pool: Executor | None = None
) -> dict[str, Any]:
    """Evaluate a job, in ``pool`` if it is given, and write the report to ``output``; returns the data of ``results.json``."""
    against = _read_other(config.against, job)
    journal = Journal(output, job.identity)
    with journal.writing() as add:
        _play(config, job, journal, add, pool)
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


def _read_other(folder: Path | None, job: Job) -> StoredEvaluation | None:
    """The evaluation to compare with. Raises ValueError unless it is of the same trials."""
    if folder is None:
        return None
    other = read_evaluation(folder)
    other.require_trials(job.identity.trials)
    return other


def _compare(outcomes: list[Outcome], against: StoredEvaluation | None) -> Comparison | None:
    return None if against is None else compare(against.results["policy"], outcomes, against.results)


def _play(
    config: EvalConfig,
    job: Job,
    journal: Journal,
    add: Callable[[Outcome], None],
    pool: Executor | None,
) -> None:
    """Play the seeds that are left, adding to the journal as they come."""
    left = [seed for seed in job.seeds if seed not in journal.done]
    if not left:
        return
    writer = RecordingWriter(journal.folder / "rerun", config.rerun, config.seed) if config.rerun != "none" else None
    with (
        tqdm(total=len(job.seeds), initial=len(journal.done), desc=f"evaluating {job.task}", unit="episode") as bar,
        closing(evaluate(job, left, min(config.workers, len(left)), writer, pool)) as stream,
    ):
        for outcome in stream:
            add(outcome)
            successes = sum(entry.success for entry in journal.done.values())
            bar.set_postfix(success=f"{100 * successes / len(journal.done):.1f}%", refresh=False)
            bar.update()


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
