"""Every model of the paper on one task, open and closed loop, beside the paper's numbers.

python scripts/presets.py                 trains and evaluates what is missing, then writes docs/presets.md and .json
python scripts/presets.py --parameters    prints the number of parameters of each preset, and stops

What is done is skipped, be it in the outputs or in the JSON: after Ctrl-C, or on another day, the same command goes on. Each
model trains on the same demonstrations for the same number of steps and is evaluated on the same held-out seeds.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from lerobot_policy_hdril import HDRILConfig
from lerobot_policy_hdril.presets import PRESETS
from stages import Stage, checkpoint, commit, evaluation_stage, record_stage, run_chains, train_stage

ROLLOUTS = ("closed_loop", "open_loop")

# Tables 1 and 2 of the paper: success in percent of 127 tests, position error in cm, angular error in rad, DTW.
PAPER: dict[str, tuple[int, float, float, float]] = {
    "gru_gru": (13, 6.53, 0.139, 0.135),
    "res": (13, 7.74, 0.143, 0.124),
    "int": (17, 6.67, 0.145, 0.123),
    "resint": (72, 5.64, 0.121, 0.128),
    "gru_gru_multi": (14, 6.53, 0.139, 0.131),
    "res_multi": (92, 4.97, 0.123, 0.121),
    "int_multi": (13, 11.69, 0.246, 0.126),
    "hdril_paper": (100, 5.01, 0.112, 0.119),
    "res_relational": (16, 8.15, 0.171, 0.133),
}


def parameters(preset: str, dataset: Path) -> dict[str, int]:
    """Parameters of the dynamics and of the planner."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.policies.factory import make_policy

    metadata = LeRobotDatasetMetadata("hdril/presets", root=dataset)
    policy: Any = make_policy(HDRILConfig(device="cpu", push_to_hub=False, preset=preset), ds_meta=metadata)
    return {part: sum(p.numel() for p in getattr(policy, part).parameters()) for part in ("dynamics", "planner")}


def chain(preset: str, options: argparse.Namespace, dataset: Path) -> list[Stage]:
    """Training and the two evaluations of one preset."""
    folder = options.output / preset
    batch = f"--batch_size={options.batch_size}"
    policy = checkpoint(folder / "train", options.steps)
    return [
        train_stage(preset, f"presets/{preset}", dataset, folder / "train", options.steps, batch),
        *(
            evaluation_stage(f"{preset}, {rollout}", options.task, policy, folder / rollout, options.episodes, options.seed,
                             f"--policy.rollout={rollout}")
            for rollout in ROLLOUTS
        ),
    ]  # fmt: skip


def markdown(results: dict[str, Any]) -> str:
    """The table."""
    header = ("preset", "parameters", "closed loop", "open loop", "position, cm", "angle, rad", "DTW, cm",
              "paper: success", "position, cm", "angle, rad", "DTW")  # fmt: skip
    commits = sorted({row["commit"] for row in results["presets"].values()})
    lines = [
        f"# The paper's models on {results['task']}",
        "",
        f"{results['demonstrations']} demonstrations, {results['steps']} steps of batch {results['batch_size']} each; "
        f"{results['episodes']} held-out seeds from {results['seed']} on. Made by `python scripts/presets.py` on commit "
        f"{', '.join(commits)}. Success in percent with the 95 % interval; errors against the expert in the open loop, as in the "
        "paper, mean ± standard deviation over episodes.",
        "",
        "| " + " | ".join(header) + " |",
        "|" + "---|" * len(header),
    ]
    for preset, row in results["presets"].items():

        def rate(rollout: str, row: dict[str, Any] = row) -> str:
            low, high = row[rollout]["pc_success_ci95"]
            return f"{row[rollout]['pc_success']:.1f} ({low:.1f} to {high:.1f})"

        def error(key: str, digits: int, row: dict[str, Any] = row) -> str:
            value = row["open_loop"][key]
            return f"{value['mean']:.{digits}f} ± {value['std']:.{digits}f}"

        paper = PAPER.get(preset)
        theirs = [f"{paper[0]} %", *map(str, paper[1:])] if paper else [""] * 4
        cells = [
            preset, f"{row['parameters']['dynamics'] + row['parameters']['planner']:,}", *map(rate, ROLLOUTS),
            error("position_error_cm", 2), error("angle_error_rad", 3), error("dtw_cm", 2), *theirs,
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def finished(document: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Rows of an earlier run with the same settings.

    Raises:
        SystemExit: the document is of other settings.
    """
    if not document.exists():
        return {}
    results = json.loads(document.read_text())
    other = {key: results[key] for key, value in settings.items() if results[key] != value}
    if other:
        sys.exit(f"presets: {document} was made with {other}; give the same, or another --document")
    return results["presets"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="table_lift")
    parser.add_argument("--presets", nargs="+", default=list(PRESETS), choices=list(PRESETS), metavar="PRESET")
    parser.add_argument("--demonstrations", type=int, default=500)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=300_000)
    parser.add_argument("--jobs", type=int, default=2, help="presets at a time")
    parser.add_argument("--output", type=Path, default=Path("outputs/presets"))
    parser.add_argument("--document", type=Path, default=Path("docs/presets"), help="where the table goes")
    parser.add_argument("--parameters", action="store_true", help="print the numbers of parameters and stop")
    options = parser.parse_args()
    dataset = options.output / ("sample" if options.parameters else "dataset")
    settings = {
        key: getattr(options, key) for key in ("task", "demonstrations", "steps", "batch_size", "episodes", "seed")
    }
    known = {} if options.parameters else finished(options.document.with_suffix(".json"), settings)
    missing = [preset for preset in options.presets if preset not in known]
    if not missing:
        print(f"{options.document.with_suffix('.json')} has them all")
        return
    count = 1 if options.parameters else options.demonstrations
    run_chains([[record_stage(options.task, "hdril/presets", dataset, count)]])
    if options.parameters:
        for preset in options.presets:
            counts = parameters(preset, dataset)
            print(f"{preset:24} dynamics {counts['dynamics']:>10,}   planner {counts['planner']:>8,}")
        return

    run_chains([chain(preset, options, dataset) for preset in missing], options.jobs)
    for preset in missing:
        row: dict[str, Any] = {"commit": commit(), "parameters": parameters(preset, dataset)}
        for rollout in ROLLOUTS:
            summary = json.loads((options.output / preset / rollout / "results.json").read_text())
            row[rollout] = {key: value for key, value in summary.items() if key not in ("per_episode", "policy")}
        known[preset] = row
    results = settings | {"presets": {preset: known[preset] for preset in PRESETS if preset in known}}
    options.document.parent.mkdir(parents=True, exist_ok=True)
    options.document.with_suffix(".json").write_text(json.dumps(results, indent=1))
    options.document.with_suffix(".md").write_text(markdown(results))
    print(markdown(results))


if __name__ == "__main__":
    main()
