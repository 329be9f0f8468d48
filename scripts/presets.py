"""Every model of the paper on one task, open and closed loop, beside the paper's numbers.

python scripts/presets.py                  trains and evaluates what is missing, then writes docs/presets.md and .json
python scripts/presets.py --parameters     prints the number of parameters of each preset, and stops
python scripts/presets.py --report-only    writes the .md again from the .json

A model whose results are in the outputs or in the JSON is skipped: after Ctrl-C the same command continues. Each model trains
once, on the same demonstrations for the same number of steps, and is evaluated on the same held-out seeds.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from lerobot_policy_hdril import HDRILConfig
from lerobot_policy_hdril.presets import PRESETS
from pairs import paired_p_value, summarise
from stages import Stage, checkpoint, commit, evaluation_stage, record_stage, run_chains, train_stage

from hdril.evaluation.statistics import holm
from hdril.markdown import table

ROLLOUTS = ("closed_loop", "open_loop")
BASELINE = "hdril"
"""The preset that the others are compared with."""

# Tables 1 and 2 of the paper: success in percent of 127 tests, position error in cm, angular error in rad. Its DTW distance is
# left out: the paper does not define it, so that ours cannot be set beside it.
PAPER: dict[str, tuple[int, float, float]] = {
    "gru_gru": (13, 6.53, 0.139),
    "res": (13, 7.74, 0.143),
    "int": (17, 6.67, 0.145),
    "resint": (72, 5.64, 0.121),
    "gru_gru_multi": (14, 6.53, 0.139),
    "res_multi": (92, 4.97, 0.123),
    "int_multi": (13, 11.69, 0.246),
    "hdril_paper": (100, 5.01, 0.112),
    "res_relational": (16, 8.15, 0.171),
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
    model = (f"--policy.preset={preset}", f"--batch_size={options.batch_size}")
    policy = checkpoint(folder / "train", options.steps)
    return [
        train_stage(preset, f"train/{options.task}", dataset, folder / "train", options.steps, *model),
        *(
            evaluation_stage(f"{preset}, {rollout}", options.task, policy, folder / rollout, options.episodes, options.seed,
                             f"--policy.rollout={rollout}")
            for rollout in ROLLOUTS
        ),
    ]  # fmt: skip


def markdown(results: dict[str, Any]) -> str:
    """The tables."""
    presets = results["presets"]
    commits = sorted({row["commit"] for row in presets.values()})
    dtw = all("dtw_cm" in row["open_loop"] for row in presets.values())
    columns = [("position_error_cm", "position, cm", 2), ("angle_error_rad", "angle, rad", 3), ("dtw_cm", "DTW, cm", 2)]
    errors = columns if dtw else columns[:2]
    heads = ("preset", "parameters", "closed loop", "open loop", *(head for _, head, _ in errors),
             "paper: success", "position, cm", "angle, rad")  # fmt: skip
    blocks = [
        f"# The paper's models on {results['task']}",
        f"{results['demonstrations']} demonstrations, {results['steps']} steps of batch {results['batch_size']} each; "
        f"{results['episodes']} held-out seeds from {results['seed']} on. Made by `python scripts/presets.py` on commit "
        f"{', '.join(commits)}. Success in percent with the 95 % interval (Wilson) over the seeds; errors against the expert in "
        "the open loop, as in the paper, mean ± standard deviation over episodes.",
        "Each model was trained once. The intervals say how often this trained policy succeeds; they do not say what another "
        "training of the same model gives. A difference between two rows is a difference between two trained policies.",
        _about_dtw(dtw),
        table(heads, [_row(preset, row, errors) for preset, row in presets.items()]),
        *_tests(presets),
    ]
    return "\n\n".join(blocks) + "\n"


def _about_dtw(there: bool) -> str:
    paper = "The paper's DTW distance is not listed, because the paper does not define it."
    ours = (
        "Ours is the mean distance along the optimal warping path."
        if there
        else "Ours awaits a new run: these results were made with an earlier definition, which shrank with the number of frames."
    )
    return f"{paper} {ours}"


def _row(preset: str, row: dict[str, Any], errors: list[tuple[str, str, int]]) -> list[str]:
    paper = PAPER.get(preset)
    theirs = [f"{paper[0]} %", *map(str, paper[1:])] if paper else [""] * 3
    spreads = [(row["open_loop"][key], digits) for key, _, digits in errors]
    return [
        preset,
        f"{row['parameters']['dynamics'] + row['parameters']['planner']:,}",
        *(_rate(row[rollout]) for rollout in ROLLOUTS),
        *(f"{spread['mean']:.{digits}f} ± {spread['std']:.{digits}f}" for spread, digits in spreads),
        *theirs,
    ]


def _rate(summary: dict[str, Any]) -> str:
    low, high = summary["pc_success_ci95"]
    return f"{summary['pc_success']:.1f} ({low:.1f} to {high:.1f})"


def _tests(presets: dict[str, Any]) -> list[str]:
    """McNemar's exact test of each preset against the baseline, if the baseline is there."""
    others = [preset for preset in presets if preset != BASELINE]
    if BASELINE not in presets or not others:
        return []
    cases = [(preset, rollout) for preset in others for rollout in ROLLOUTS]
    p_values = [paired_p_value(presets[preset][rollout], presets[BASELINE][rollout]) for preset, rollout in cases]
    adjusted = holm([p.value for p in p_values])
    texts = {case: p.text(value) for case, p, value in zip(cases, p_values, adjusted, strict=True)}
    bound = " ≤ marks the largest p that the numbers of successes allow." if any(not p.exact for p in p_values) else ""
    rows = [[preset, *(texts[preset, rollout] for rollout in ROLLOUTS)] for preset in others]
    return [
        f"## Against `{BASELINE}`, seed by seed",
        f"p of McNemar's exact test of equal success rates of the two trained policies on the same seeds, adjusted by Holm's "
        f"method for the {len(cases)} tests of the table.{bound}",
        table(("preset", "closed loop", "open loop"), rows),
    ]


def finished(document: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Rows of an earlier run with the same settings.

    Raises:
        SystemExit: the document was made with other settings.
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
    # A model that plans no further than it acts has no open loop.
    whole = [name for name, values in PRESETS.items() if values["coordinates"] != "fused"]
    parser.add_argument("--presets", nargs="+", default=whole, choices=whole, metavar="PRESET")
    parser.add_argument("--demonstrations", type=int, default=500)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=300_000)
    parser.add_argument("--jobs", type=int, default=2, help="presets at a time")
    parser.add_argument("--output", type=Path, default=Path("outputs/presets"))
    parser.add_argument("--document", type=Path, default=Path("docs/presets"), help="where the table goes")
    parser.add_argument("--parameters", action="store_true", help="print the numbers of parameters and stop")
    parser.add_argument("--report-only", action="store_true", help="write the tables from the .json; train nothing")
    options = parser.parse_args()
    data = options.document.with_suffix(".json")
    if options.report_only:
        if not data.exists():
            parser.error(f"--report-only needs {data}, which is not there")
        options.document.with_suffix(".md").write_text(markdown(json.loads(data.read_text())))
        return
    dataset = options.output / ("sample" if options.parameters else "dataset")
    settings = {
        key: getattr(options, key) for key in ("task", "demonstrations", "steps", "batch_size", "episodes", "seed")
    }
    known = {} if options.parameters else finished(data, settings)
    missing = [preset for preset in options.presets if preset not in known]
    if not missing:
        print(f"{data} has them all")
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
            row[rollout] = summarise(summary)
        known[preset] = row
    results = settings | {"presets": {preset: known[preset] for preset in PRESETS if preset in known}}
    options.document.parent.mkdir(parents=True, exist_ok=True)
    data.write_text(json.dumps(results, indent=1))
    options.document.with_suffix(".md").write_text(markdown(results))
    print(markdown(results))


if __name__ == "__main__":
    main()
