"""How long HDR-IL trains, from how many demonstrations it learns, and with which latent.

python scripts/learning.py                  trains and evaluates what is missing, then writes docs/learning.md, .json and .png
python scripts/learning.py --report-only    writes the .md and .png again from the .json

Four questions, each with stock ``lerobot-train`` and held-out seeds: success after so many minutes of training; success of
the last checkpoint on many seeds; success from few demonstrations, on disjoint choices of them; and the latent
(deterministic, variational, sampled), on seeds that nothing else uses, because the answer chooses a default.
What is done is skipped: after Ctrl-C the same command continues.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

from learning_report import draw, markdown
from stages import Stage, checkpoint, commit, evaluation_stage, record_stage, run_chains, train_stage

SETTINGS_LEFT_OUT = ("output", "document", "jobs", "report_only")
CURVE_STRIDE = 100
CURVE_STEPS = (100, 200, 300, 500, 700, 1000, 1500, 2000, 2500)

# Options of training and of evaluation. Two latents with the same options of training are trained once.
LATENTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "deterministic": (("--policy.latent=deterministic",), ()),
    "variational, KL weight 0, mean": (("--policy.latent=variational",), ()),
    "variational, KL weight 0, 5 samples": (("--policy.latent=variational",), ("--policy.samples=5",)),
    "variational, KL weight 0.001, mean": (("--policy.latent=variational", "--policy.kl_weight=0.001"), ()),
    "variational, KL weight 0.001, 5 samples": (
        ("--policy.latent=variational", "--policy.kl_weight=0.001"),
        ("--policy.samples=5",),
    ),
}


def subset(size: int, number: int) -> str:
    """The option that trains on the ``number``-th ``size`` demonstrations."""
    return f"--dataset.episodes={list(range(number * size, (number + 1) * size))}"


class Study:
    """The folders of a run, the stages that fill them, and what they found."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.config = f"train/{options.task}"
        self.dataset = options.output / "dataset"
        self.curve = options.output / "curve"
        self.started = self.curve / "started.json"
        self.steps = sorted({step for step in CURVE_STEPS if step < options.steps} | {options.steps})

    def train_curve(self) -> None:
        """Train with all demonstrations while nothing else runs, and remember when it began."""
        stage = train_stage("all demonstrations", self.config, self.dataset, self.curve / "train",
                            self.options.steps, save_every=CURVE_STRIDE)  # fmt: skip
        if not stage.result.exists():
            self.curve.mkdir(parents=True, exist_ok=True)
            self.started.write_text(json.dumps({"time": time.time(), "cores": os.cpu_count()}))
        run_chains([[stage]])

    def _evaluate(self, title: str, policy: Path, output: Path) -> Stage:
        options = self.options
        return evaluation_stage(title, options.task, policy, output, options.episodes, options.seed)

    def few_train(self, size: int, number: int) -> Stage:
        """Training on few demonstrations, with the default latent."""
        return train_stage(f"{size} demonstrations, choice {number}", self.config, self.dataset,
                           self.few(size, number) / "train", self.options.few_steps, subset(size, number))  # fmt: skip

    def few(self, size: int, number: int) -> Path:
        return self.options.output / f"few_{size}_{number}"

    def latent(self, name: str, number: int | None) -> tuple[Path, Path]:
        """Folders of training and evaluation. ``number``: the choice of few demonstrations; None: all of them."""
        options = self.options
        base = self.curve if number is None else self.few(options.few[0], number)
        training, evaluating = LATENTS[name]
        if name != "deterministic":
            base = base.with_name(base.name + "".join(option.split(".", 1)[1].replace("=", "_") for option in training))
        return base / "train", base / ("latent_sampled" if evaluating else "latent")

    def chains(self) -> list[list[Stage]]:
        """All but :meth:`train_curve` and :meth:`final`."""
        options = self.options
        after = [
            [self._evaluate(f"after {step} steps", checkpoint(self.curve / "train", step), self.curve / f"{step}")]
            for step in self.steps
        ]
        trained: dict[Path, list[Stage]] = {}  # a chain: a training, then the evaluations of its policy
        for size in options.few:
            for number in range(options.choices):
                train, folder = self.few_train(size, number), self.few(size, number)
                trained[folder / "train"] = [
                    train,
                    self._evaluate(train.title, train.result.parent, folder / "eval"),
                ]
        for number in (None, *range(options.choices)):
            for name, (training, evaluating) in LATENTS.items():
                train, output = self.latent(name, number)
                title = f"{name}, {'all' if number is None else f'choice {number}'}"
                steps = options.steps if number is None else options.few_steps
                if train not in trained:
                    choice = () if number is None else (subset(options.few[0], number),)
                    trained[train] = [train_stage(title, self.config, self.dataset, train, steps, *choice, *training)]
                trained[train].append(
                    evaluation_stage(title, options.task, checkpoint(train, steps), output, options.latent_episodes,
                                     options.latent_seed, *evaluating)
                )  # fmt: skip
        return [*after, *trained.values()]

    def final(self) -> Stage:
        """The last checkpoint on many seeds, with all cores."""
        options = self.options
        return evaluation_stage("the last checkpoint", options.task, checkpoint(self.curve / "train", options.steps),
                                options.output / "final", options.held_out, options.held_out_seed,
                                workers=options.jobs)  # fmt: skip

    def minutes(self, steps: int) -> float:
        """From the start of the command until the checkpoint was there."""
        saved = (checkpoint(self.curve / "train", steps) / "model.safetensors").stat().st_mtime
        return (saved - json.loads(self.started.read_text())["time"]) / 60.0

    def results(self) -> dict[str, Any]:
        """Everything that was found, as plain data."""
        options = self.options
        few = {
            str(size): [_summary(self.few(size, number) / "eval") for number in range(options.choices)]
            for size in options.few
        }
        latents = {
            name: {
                "all": _summary(self.latent(name, None)[1]),
                "few": [_summary(self.latent(name, number)[1]) for number in range(options.choices)],
            }
            for name in LATENTS
        }
        settings = {key: value for key, value in vars(options).items() if key not in SETTINGS_LEFT_OUT}
        return settings | {
            "commit": commit(),
            "cores": json.loads(self.started.read_text())["cores"],
            "curve": [
                {"steps": step, "minutes": self.minutes(step)} | _summary(self.curve / f"{step}") for step in self.steps
            ],
            "final": _summary(options.output / "final"),
            "few_shot": few,
            "latent": latents,
        }


def _summary(folder: Path) -> dict[str, Any]:
    """What the report needs of an evaluation. ``failed_seeds`` lets it pair two evaluations seed by seed."""
    summary = json.loads((folder / "results.json").read_text())
    keys = (
        "first_seed",
        "n_episodes",
        "n_success",
        "pc_success",
        "pc_success_ci95",
        "position_error_cm",
        "stages_reached",
    )
    return {key: summary[key] for key in keys} | {
        "failed_seeds": [episode["seed"] for episode in summary["per_episode"] if not episode["success"]],
        "planner_pc_correct": summary["planner"]["pc_correct"],
    }


def write(found: dict[str, Any], document: Path) -> None:
    """Write the text and the picture of the report."""
    picture = document.with_suffix(".png")
    draw(found, picture)
    document.with_suffix(".md").write_text(markdown(found, picture.name))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="table_lift")
    parser.add_argument("--demonstrations", type=int, default=500)
    parser.add_argument("--steps", type=int, default=3000, help="of training on all demonstrations, a multiple of 100")
    parser.add_argument("--episodes", type=int, default=200, help="seeds of each evaluation but the last")
    parser.add_argument("--seed", type=int, default=400_000)
    parser.add_argument("--held-out", type=int, default=1000, help="seeds for the last checkpoint")
    parser.add_argument("--held-out-seed", type=int, default=100_000)
    parser.add_argument("--latent-episodes", type=int, default=100, help="seeds of each evaluation of a latent")
    parser.add_argument("--latent-seed", type=int, default=500_000)
    parser.add_argument(
        "--few", type=int, nargs="+", default=[10, 50], help="numbers of demonstrations; the latents use the first"
    )
    parser.add_argument("--few-steps", type=int, default=1000)
    parser.add_argument("--choices", type=int, default=3, help="disjoint choices of few demonstrations")
    parser.add_argument("--jobs", type=int, default=2, help="commands at a time")
    parser.add_argument("--output", type=Path, default=Path("outputs/learning"))
    parser.add_argument(
        "--document", type=Path, default=Path("docs/learning"), help="where the report goes, without suffix"
    )
    parser.add_argument("--report-only", action="store_true", help="write the report from its .json; train nothing")
    options = parser.parse_args()
    data = options.document.with_suffix(".json")
    if options.report_only:
        if not data.exists():
            parser.error(f"--report-only needs {data}, which is not there")
        write(json.loads(data.read_text()), options.document)
        return
    if options.steps % CURVE_STRIDE:
        parser.error(f"--steps must be a multiple of {CURVE_STRIDE}, got {options.steps}")
    if max(options.few) * options.choices > options.demonstrations:
        parser.error(
            f"--choices={options.choices} of {max(options.few)} need more than {options.demonstrations} demonstrations"
        )
    study = Study(options)
    run_chains([[record_stage(options.task, "hdril/learning", study.dataset, options.demonstrations)]])
    study.train_curve()
    run_chains([[study.final()]])
    run_chains(study.chains(), options.jobs)
    found = study.results()
    options.document.parent.mkdir(parents=True, exist_ok=True)
    data.write_text(json.dumps(found, indent=1))
    write(found, options.document)
    print(options.document.with_suffix(".md").read_text())


if __name__ == "__main__":
    main()
