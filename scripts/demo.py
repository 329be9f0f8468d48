"""Table lift from nothing to an evaluated policy: what ``make demo`` runs.

Each stage is one command that a user could type; it is printed before it runs. A stage whose result is there already is
skipped, so an interrupted demo goes on where it was.
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
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Stage:
    """A command and the file that is there when it is done."""

    title: str
    command: tuple[str, ...]
    result: Path
    threads: int | None = None
    """Threads of PyTorch; as many as it likes unless given."""

    def run(self) -> float:
        """Seconds it took; 0 if it was done before."""
        variables = {} if self.threads is None else {"OMP_NUM_THREADS": str(self.threads)}
        prefix = "".join(f"{name}={value} " for name, value in variables.items())
        print(f"\n== {self.title}\n$ {prefix}{shlex.join(self.command)}", flush=True)
        if self.result.exists():
            print(f"done before: {self.result}")
            return 0.0
        start = time.monotonic()
        program = Path(sys.executable).with_name(self.command[0])
        subprocess.run([program, *self.command[1:]], check=True, env=os.environ | variables)
        return time.monotonic() - start


def stages(output: Path, episodes: int, steps: int, evaluations: int) -> list[Stage]:
    """The pipeline. ``output`` is where everything goes."""
    dataset, train = output / "dataset", output / "train"
    checkpoint = train / "checkpoints" / "last" / "pretrained_model"
    return [
        Stage(
            f"{episodes} demonstrations",
            ("hdril-record", "--task=table_lift", "--repo_id=hdril/table_lift", f"--root={dataset}",
             f"--num_episodes={episodes}"),
            dataset / "meta" / "info.json",
        ),
        Stage(
            f"training, {steps} steps",
            ("lerobot-train", "--config_path=configs/train/table_lift.yaml", f"--dataset.root={dataset}",
             f"--output_dir={train}", f"--steps={steps}", f"--save_freq={steps}"),
            train / "checkpoints" / f"{steps:06d}" / "pretrained_model" / "model.safetensors",
            threads=1,  # the matrices are small: a second thread slows them down
        ),
        Stage(
            "evaluation with LeRobot's own command, 10 episodes",
            ("lerobot-eval", f"--policy.path={checkpoint}", "--env.type=hdril", "--env.task=table_lift",
             "--eval.n_episodes=10", "--eval.batch_size=2", "--eval.use_async_envs=true", "--seed=200000",
             f"--output_dir={output / 'lerobot-eval'}"),
            output / "lerobot-eval" / "eval_info.json",
        ),
        Stage(
            f"evaluation on {evaluations} held-out seeds, with a report and recordings",
            ("hdril-eval", f"--policy.path={checkpoint}", "--task=table_lift", f"--num_episodes={evaluations}",
             "--rerun=2", f"--output_dir={output / 'eval'}"),
            output / "eval" / "results.json",
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
        # A training that was cut off before its checkpoint leaves a folder that lerobot-train refuses to reuse.
        if stage.command[0] == "lerobot-train" and not stage.result.exists():
            shutil.rmtree(options.output / "train", ignore_errors=True)
        try:
            seconds[stage.title] = stage.run()
        except subprocess.CalledProcessError as error:
            sys.exit(
                f"demo: {stage.command[0]} failed with exit code {error.returncode}; run the command above to see why"
            )
        except KeyboardInterrupt:
            sys.exit("\ndemo: interrupted; run it again to go on")
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
