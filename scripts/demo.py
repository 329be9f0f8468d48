"""Table lift from nothing to an evaluated policy: what ``make demo`` runs.

Each stage is one command that a user could type; it is printed before it runs. A stage whose result is there is skipped, so
an interrupted demo continues where it stopped.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from stages import Stage, record_stage, train_stage, weights


def stages(output: Path, episodes: int, steps: int, evaluations: int) -> list[Stage]:
    """The pipeline. ``output`` is where everything goes."""
    dataset, train = output / "dataset", output / "train"
    policy = train / "checkpoints" / "last" / "pretrained_model"
    return [
        record_stage("table_lift", "hdril/table_lift", dataset, episodes),
        train_stage("HDR-IL", "train/table_lift", dataset, train, steps),
        Stage(
            "evaluation with LeRobot's own command, 10 episodes",
            ("lerobot-eval", f"--policy.path={policy}", "--env.type=hdril", "--env.task=table_lift",
             "--eval.n_episodes=10", "--eval.batch_size=2", "--eval.use_async_envs=true", "--seed=200000",
             f"--output_dir={output / 'lerobot-eval'}"),
            output / "lerobot-eval",
            output / "lerobot-eval" / "eval_info.json",
            weights(policy),
            resumes=False,
        ),
        Stage(
            f"evaluation on {evaluations} held-out seeds, with a report and recordings",
            ("hdril-eval", f"--policy.path={policy}", "--task=table_lift", f"--num_episodes={evaluations}",
             "--rerun=2", f"--output_dir={output / 'eval'}"),
            output / "eval",
            output / "eval" / "results.json",
            weights(policy),
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
