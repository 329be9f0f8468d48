"""Does a task tell good models from bad ones? Models of HDR-IL, and linear maps alone, on scenes that vary.

python scripts/separation.py                       trains and evaluates what is missing, then writes docs/separation.md and .json
python scripts/separation.py --tasks table_lift    one task
python scripts/separation.py --models linear gru_gru    some models

For each task: demonstrations at the level ``varied``, one training of each model on them, and the same held-out seeds for all.
``linear`` has linear maps alone, once a primitive or at every frame; ``hdril_reactive`` looks at every frame too.
After Ctrl-C the same command continues.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from pairs import paired_p_value, summarise
from stages import Stage, checkpoint, commit, evaluation_stage, record_stage, run_chains, train_stage

from hdril.evaluation.statistics import holm
from hdril.files import write_atomically
from hdril.markdown import table
from hdril.tasks import TASKS

MODELS: dict[str, tuple[str, ...]] = {
    "linear": ("--policy.preset=linear",),
    "linear_every_frame": ("--policy.preset=linear_every_frame",),
    "gru_gru": ("--policy.preset=gru_gru",),
    "hdril_paper": ("--policy.preset=hdril_paper",),
    "hdril": ("--policy.preset=hdril",),
    "hdril_reactive": ("--policy.preset=hdril_reactive",),
}
"""Models by the name of their row, weakest first as one would expect."""


def training(task: str, options: argparse.Namespace) -> list[list[Stage]]:
    """The chains that train each model."""
    root = options.output / task
    return [
        [train_stage(f"{task}, {name}", "train/table_lift", root / "dataset", root / name / "train", options.steps,
                     f"--batch_size={options.batch_size}", *model)]
        for name, model in MODELS.items()
        if name in options.models
    ]  # fmt: skip


def evaluation(task: str, name: str, options: argparse.Namespace) -> Stage:
    """The held-out seeds of one row."""
    folder = options.output / task / name
    policy, title = checkpoint(folder / "train", options.steps), f"{task}, {name}"
    return evaluation_stage(title, f"{task}:level=varied", policy, folder / "eval", options.episodes, options.seed)


def markdown(results: dict[str, Any]) -> str:
    """The tables."""
    blocks = [
        "# Which tasks tell models apart",
        f"{results['demonstrations']} demonstrations of scenes that vary (level `varied`), {results['steps']} steps of batch "
        f"{results['batch_size']}, {results['episodes']} held-out seeds from {results['seed']} on. Made by "
        "`python scripts/separation.py`. Success in percent with the 95 % interval (Wilson). Each model was trained once: an "
        "interval says how often this trained policy succeeds, and not what another training gives. p is of McNemar's exact test "
        "against `hdril`, adjusted by Holm's method.",
    ]
    for task, entry in results["tasks"].items():
        rows = entry["rows"]
        others = [name for name in rows if name != "hdril" and "hdril" in rows]
        tests = [paired_p_value(rows[name], rows["hdril"]) for name in others]
        texts = {
            name: p.text(value) for name, p, value in zip(others, tests, holm([p.value for p in tests]), strict=True)
        }
        lines = [
            [name, "{:.1f} ({:.1f} to {:.1f})".format(row["pc_success"], *row["pc_success_ci95"]), texts.get(name, "")]
            for name, row in rows.items()
        ]
        rates = [row["pc_success"] for row in rows.values()]
        blocks += [
            f"## {task}",
            f"Made on commit {entry['commit']}."
            + (f" From the weakest to the strongest: {max(rates) - min(rates):.1f} points." if others else ""),
            table(["model", "success", "p"], lines),
        ]
    return "\n\n".join(blocks) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS), metavar="TASK")
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS), metavar="MODEL")
    parser.add_argument("--demonstrations", type=int, default=500)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=300_000)
    parser.add_argument("--jobs", type=int, default=2, help="models at a time")
    parser.add_argument("--output", type=Path, default=Path("outputs/separation"))
    parser.add_argument("--document", type=Path, default=Path("docs/separation"), help="where the tables go")
    options = parser.parse_args()
    data = options.document.with_suffix(".json")
    results: dict[str, Any] = json.loads(data.read_text()) if data.exists() else {"tasks": {}}
    settings = {key: getattr(options, key) for key in ("demonstrations", "steps", "batch_size", "episodes", "seed")}
    if other := {key: results[key] for key, value in settings.items() if results.get(key, value) != value}:
        parser.error(f"{data} was made with {other}; give the same, or another --document")
    results |= settings
    for task in options.tasks:
        dataset = options.output / task / "dataset"
        run_chains([[record_stage(f"{task}:level=varied", "hdril/separation", dataset, options.demonstrations)]])
        run_chains(training(task, options), options.jobs)
        stages = {name: evaluation(task, name, options) for name in options.models}
        run_chains([[stage] for stage in stages.values()], options.jobs)
        rows = {name: summarise(json.loads(stage.result.read_text())) for name, stage in stages.items()}
        known = results["tasks"].get(task, {"rows": {}})["rows"] | rows
        ordered = {name: known[name] for name in MODELS if name in known}
        results["tasks"][task] = {"commit": commit(), "rows": ordered}
        write_atomically(data, lambda file: file.write(json.dumps(results, indent=1).encode()))
        options.document.with_suffix(".md").write_text(markdown(results))


if __name__ == "__main__":
    main()
