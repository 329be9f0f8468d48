"""Table lift from nothing to an evaluated policy: what ``make demo`` runs.

Each stage is one command that a user could type; it is printed before it runs. A stage whose result is there is skipped, so
an interrupted demo continues where it stopped. A result is kept only while it was made by the same command from the same input
files by the same software: next to each output folder is a file ``<folder>.made_from`` that says what it is made from. So a
policy that was trained again is evaluated again.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hdril.benchmark.steps import training_software
from hdril.digest import digest_file
from hdril.evaluation.software import evaluation_software, recording_software

CONFIG = Path("configs/train/table_lift.yaml")


@dataclass(frozen=True)
class Stage:
    """A command, the folder that it writes, and the file in there that is present when it is done."""

    title: str
    command: tuple[str, ...]
    output: Path
    result: Path
    inputs: tuple[Path, ...] = ()
    """Files that the result is made from."""
    software: Mapping[str, str] = field(default_factory=dict)
    """Versions and digests of the sources that decide the result."""
    threads: int | None = None
    """Threads of PyTorch; PyTorch's own choice unless given."""
    resumes: bool = True
    """Whether the command continues where it was interrupted. If not, what it left is removed before it runs again."""

    def run(self) -> float:
        """Run the command unless its result is there.

        Returns:
            Seconds it took; 0 if it was done before.

        Raises:
            subprocess.CalledProcessError: the command failed.
            FileNotFoundError: an input is missing.
        """
        variables = {} if self.threads is None else {"OMP_NUM_THREADS": str(self.threads)}
        prefix = "".join(f"{name}={value} " for name, value in variables.items())
        print(f"\n== {self.title}\n$ {prefix}{shlex.join(self.command)}", flush=True)
        made_from = self._made_from()
        same = self._record.exists() and self._record.read_text() == made_from
        if same and self.result.exists():
            print(f"done before: {self.result}")
            return 0.0
        if not (same and self.resumes):
            self._remove(made_from)
        start = time.monotonic()
        program = Path(sys.executable).with_name(self.command[0])
        subprocess.run([program, *self.command[1:]], check=True, env=os.environ | variables)
        return time.monotonic() - start

    @property
    def _record(self) -> Path:
        return self.output.with_name(f"{self.output.name}.made_from")

    def _made_from(self) -> str:
        """The command, the digests of the inputs and the software, as JSON."""
        digests = {str(path): digest_file(path) for path in self.inputs}
        return json.dumps({"command": self.command, "inputs": digests, "software": dict(self.software)}, indent=1)

    def _remove(self, made_from: str) -> None:
        """Remove the result of something else and the rest of an interrupted run, and record what is made now."""
        if self.result.exists():
            print(f"made from something else, made again: {self.output}", flush=True)
        for folder in (self.output, self.output.with_name(f"{self.output.name}.partial")):
            shutil.rmtree(folder, ignore_errors=True)
        self._record.parent.mkdir(parents=True, exist_ok=True)
        self._record.write_text(made_from)


def weights(policy: Path) -> tuple[Path, ...]:
    """The files that make a checkpoint the policy that it is."""
    return policy / "model.safetensors", policy / "config.json"


def stages(output: Path, episodes: int, steps: int, evaluations: int) -> list[Stage]:
    """The pipeline. ``output`` is where everything goes."""
    dataset, train = output / "dataset", output / "train"
    policy = train / "checkpoints" / "last" / "pretrained_model"
    learner = training_software("hdril")
    played = learner | evaluation_software("table_lift")
    return [
        Stage(
            f"{episodes} demonstrations",
            ("hdril-record", "--task=table_lift", "--repo_id=hdril/table_lift", f"--root={dataset}",
             f"--num_episodes={episodes}"),
            dataset,
            dataset / "meta" / "info.json",
            software=recording_software("table_lift"),
        ),
        Stage(
            f"HDR-IL: training, {steps} steps",
            ("lerobot-train", f"--config_path={CONFIG}", f"--dataset.root={dataset}", f"--output_dir={train}",
             f"--steps={steps}", f"--save_freq={steps}"),
            train,
            train / "checkpoints" / f"{steps:06d}" / "pretrained_model" / "model.safetensors",
            (CONFIG, dataset / "meta" / "info.json", dataset / "meta" / "stats.json"),
            software=learner,
            threads=1,  # the matrices are small: a second thread slows training down
            resumes=False,  # lerobot-train refuses the folder that it left
        ),
        Stage(
            "evaluation with LeRobot's own command, 10 episodes",
            ("lerobot-eval", f"--policy.path={policy}", "--env.type=hdril", "--env.task=table_lift",
             "--eval.n_episodes=10", "--eval.batch_size=2", "--eval.use_async_envs=true", "--seed=200000",
             f"--output_dir={output / 'lerobot-eval'}"),
            output / "lerobot-eval",
            output / "lerobot-eval" / "eval_info.json",
            weights(policy),
            played,
            resumes=False,
        ),
        Stage(
            f"evaluation on {evaluations} held-out seeds, with a report and recordings",
            ("hdril-eval", f"--policy.path={policy}", "--task=table_lift", f"--num_episodes={evaluations}",
             "--rerun=2", f"--output_dir={output / 'eval'}"),
            output / "eval",
            output / "eval" / "results.json",
            weights(policy),
            played,
        ),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("outputs/demo"))
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--evaluations", type=int, default=100)
    options = parser.parse_args()
    seconds = {}
    for stage in stages(options.output, options.episodes, options.steps, options.evaluations):
        try:
            seconds[stage.title] = stage.run()
        except subprocess.CalledProcessError as error:
            sys.exit(
                f"demo: {stage.command[0]} failed with exit code {error.returncode}; run the command above to see why"
            )
        except KeyboardInterrupt:
            sys.exit("\ndemo: interrupted; run it again to continue")
    results = json.loads((options.output / "eval" / "results.json").read_text())
    low, high = results["pc_success_ci95"]
    print(f"\n== Table lift: {results['n_success']} of {results['n_episodes']} held-out seeds, "
          f"{results['pc_success']:.1f} % (95 % interval {low:.1f} to {high:.1f})")  # fmt: skip
    for title, took in seconds.items():
        print(f"   {took:5.0f} s  {title}")
    print(f"   {sum(seconds.values()):5.0f} s  in all")
    print(f"Report:      {options.output / 'eval' / 'report.md'}")
    print(f"Videos:      {options.output / 'lerobot-eval' / 'videos'}")
    for recording in sorted((options.output / "eval" / "rerun").glob("*.rrd")):
        print(f"Recording:   .venv/bin/rerun {recording}")


if __name__ == "__main__":
    main()
