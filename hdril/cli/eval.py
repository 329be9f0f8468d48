"""hdril-eval: any LeRobot policy on held-out seeds, compared with the expert."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tqdm import tqdm

from hdril.cli.common import check_repo_id, run
from hdril.evaluation.evaluate import Job, evaluate
from hdril.evaluation.held_out import check_held_out, training_provenance
from hdril.evaluation.report import Run, headline, write_report
from hdril.evaluation.score import Outcome
from hdril.tasks import get_task
from hdril.viewer.keep import check_keep
from hdril.viewer.recordings import RecordingWriter


@dataclass
class PolicySource:
    """Which policy. Any other --policy.… option overrides its config, e.g. --policy.rollout=open_loop."""

    path: str
    """Checkpoint: a folder (…/checkpoints/last/pretrained_model) or a Hub repository."""
    device: str = "cpu"
    """Device of the policy in every worker."""


@dataclass
class EvalConfig:
    """Evaluate a LeRobot policy on held-out seeds: success with its 95 % interval, errors against the expert's
    demonstration of the same seed, a report, and Rerun recordings.

    After Ctrl-C, the same command goes on where it was.
    """

    policy: PolicySource
    task: str = "table_lift"
    """Name of the task, with its parameters if it has any (peg_in_hole:clearance=0.004); an unknown one is answered with
    those there are."""
    num_episodes: int = 100
    """Episodes, one a seed."""
    seed: int = 100_000
    """First seed. Must not overlap the seeds that the policy was trained on."""
    rerun: str = "failures"
    """Episodes to keep as Rerun recordings: failures, all, none, or a number of episodes from the first on."""
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
    if config.push:
        check_repo_id("push", config.push)
    for name, least in (("num_episodes", 1), ("seed", 0), ("workers", 1)):
        if getattr(config, name) < least:
            raise ValueError(f"{name} must be at least {least}, got {getattr(config, name)}")
    check_keep("rerun", config.rerun)
    path = Path(config.policy.path)
    looks_local = path.is_absolute() or path.parts[:1] in ((".",), ("..",)) or len(path.parts) != 2
    if not (path / "config.json").exists() and (looks_local or path.exists()):
        raise FileNotFoundError(
            f"no checkpoint at {path}: it should be a folder with config.json and model.safetensors"
        )


def eval_command(config: EvalConfig, overrides: tuple[str, ...] = ()) -> None:
    _check(config)
    output = config.output_dir or Path("outputs/eval") / f"{config.task}_{time.strftime('%Y-%m-%d_%H-%M-%S')}"
    if output.exists() and not config.push:
        raise FileExistsError(f"{output} exists; choose another output_dir or delete it")
    seeds = list(range(config.seed, config.seed + config.num_episodes))
    held_out = check_held_out(training_provenance(config.policy.path), config.task, seeds)
    if not held_out:
        print(
            f"Note: the training data of {config.policy.path} are not at hand; whether these seeds were in them is not known."
        )
    what = Run(config.task, config.policy.path, overrides, config.seed, config.num_episodes, held_out)
    if output.exists():
        _check_same(output, what)
        _push(config, output)
        return
    partial = output.with_name(output.name + ".partial")
    done = _resume(partial, what)
    job = Job(config.task, config.policy.path, overrides, config.policy.device)
    writer = RecordingWriter(partial / "rerun", config.rerun, config.seed) if config.rerun != "none" else None
    start = time.monotonic()
    outcomes = [done[seed] for seed in seeds if seed in done]
    left = [seed for seed in seeds if seed not in done]
    try:
        _play(job, left, min(config.workers, max(len(left), 1)), writer, outcomes, partial / "outcomes.jsonl")
    except Exception:
        if not outcomes:  # nothing to go on from
            shutil.rmtree(partial)
        raise
    outcomes.sort(key=lambda outcome: outcome.seed)
    summary = write_report(partial, what, outcomes)
    (partial / "run.json").unlink()
    (partial / "outcomes.jsonl").unlink()
    output.parent.mkdir(parents=True, exist_ok=True)
    partial.replace(output)
    recordings = sorted((output / "rerun").glob("*.rrd")) if (output / "rerun").exists() else []
    print(f"{headline(summary)}; {time.monotonic() - start:.0f} s")
    print(f"Report: {output / 'report.md'}")
    if recordings:
        print(f"{len(recordings)} recordings: hdril-view --run={output}")
    if config.push:
        _push(config, output)


def _check_same(output: Path, what: Run) -> None:
    """Raises FileExistsError unless ``output`` holds the results of ``what``."""
    path = output / "results.json"
    values = json.loads(path.read_text()) if path.exists() else {}
    if any(values.get(name) != value for name, value in json.loads(json.dumps(asdict(what))).items()):
        raise FileExistsError(f"{output} exists and holds something else; choose another output_dir or delete it")


def _push(config: EvalConfig, output: Path) -> None:
    """Results and report, the card, and the checkpoint if it lies here, in one commit."""
    from huggingface_hub import ModelCard

    from hdril.hub.cards import checkpoint_card, folder_of, with_evaluation
    from hdril.hub.publish import publish, read_text

    summary = json.loads((output / "results.json").read_text())
    folder, checkpoint = folder_of(summary), Path(config.policy.path)
    files: dict[str, Path | bytes] = {
        f"{folder}/{name}": output / name for name in ("results.json", "report.md", "report.png")
    }
    if config.output_dir is None:  # the default is another one each time
        print(f"Publishing {output}; should that fail, add --output_dir={output} to push it without playing anew")
    text = read_text(config.push, "README.md", "model")
    if (checkpoint / "config.json").exists():
        # What LeRobot publishes of a checkpoint: no pickles.
        files |= {path.name: path for path in checkpoint.iterdir() if path.suffix in (".safetensors", ".json", ".yaml")}
        text = text or checkpoint_card(checkpoint, config.push)
    card = with_evaluation(ModelCard(text or f"# {config.push}\n"), summary, config.push)
    files["README.md"] = str(card).encode()
    print(f"Published: {publish(config.push, 'model', files, headline(summary), config.private)}")


def _play(
    job: Job,
    seeds: list[int],
    workers: int,
    writer: RecordingWriter | None,
    outcomes: list[Outcome],
    journal: Path,
) -> None:
    """Evaluate ``seeds``, adding to ``outcomes`` and to the journal as they come."""
    with (
        journal.open("a") as file,
        tqdm(
            total=len(seeds) + len(outcomes), initial=len(outcomes), desc=f"evaluating {job.task}", unit="episode"
        ) as bar,
        closing(evaluate(job, seeds, workers, writer)) as stream,
    ):
        for outcome in stream:
            file.write(json.dumps(asdict(outcome)) + "\n")
            file.flush()
            outcomes.append(outcome)
            bar.set_postfix(success=f"{100 * sum(o.success for o in outcomes) / len(outcomes):.1f}%", refresh=False)
            bar.update()


def _resume(partial: Path, what: Run) -> dict[int, Outcome]:
    """Outcomes of an interrupted evaluation of the same thing.

    Raises:
        ValueError: the folder holds a different one.
    """
    plan, journal = partial / "run.json", partial / "outcomes.jsonl"
    text = json.dumps(asdict(what))
    if plan.exists() and plan.read_text() != text:
        raise ValueError(f"{partial} holds another unfinished evaluation; delete it or choose another output_dir")
    partial.mkdir(parents=True, exist_ok=True)
    plan.write_text(text)
    outcomes: dict[int, Outcome] = {}
    if journal.exists():
        for line in journal.read_text().splitlines():
            values = json.loads(line)
            outcomes[values["seed"]] = Outcome(
                **values | {"start": tuple(values["start"]), "primitives": tuple(values["primitives"])}
            )
    return outcomes


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
