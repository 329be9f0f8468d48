"""The scripts: which stages run again, and what the reports of the results say. Nothing is trained or played."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"
sys.path.insert(0, str(SCRIPTS))
stages, pairs, learning, learning_report, presets = (
    import_module(name) for name in ("stages", "pairs", "learning", "learning_report", "presets")
)

TRAIN = """#!/bin/sh
echo train "$OMP_NUM_THREADS" >> log
for word; do case $word in --output_dir=*) out=${word#*=};; --steps=*) steps=${word#*=};; esac; done
test -e "$out" && exit 3
folder=$out/checkpoints/$(printf %06d "$steps")/pretrained_model
mkdir -p "$folder" && cp recipe "$folder/config.json"
test -e interrupt && exit 4
cp recipe "$folder/model.safetensors"
"""
EVALUATE = """#!/bin/sh
echo evaluate >> log
for word; do case $word in --output_dir=*) out=${word#*=};; --policy.path=*) policy=${word#*=};; esac; done
test -e "$out" && exit 3
mkdir -p "$out.partial" && echo episode >> "$out.partial/outcomes"
test -e interrupt && exit 4
cp "$policy/model.safetensors" "$out.partial/results.json" && mv "$out.partial" "$out"
"""

Chain = Callable[..., list[str]]


@pytest.fixture
def chain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Chain:
    """Runs a training and an evaluation by fake commands, and tells which of them ran.

    The fake training copies the file ``recipe``; both fail half way if there is a file ``interrupt``, and refuse an output
    folder that exists.
    """
    commands = tmp_path / "bin"
    commands.mkdir()
    for name, text in (("lerobot-train", TRAIN), ("hdril-eval", EVALUATE)):
        (commands / name).write_text(text)
        (commands / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(commands / "python"))
    monkeypatch.chdir(tmp_path)
    for file in ("recipe", "configs/train/task.yaml", "dataset/meta/info.json", "dataset/meta/stats.json"):
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        Path(file).write_text("first")

    def run(*, steps: int = 5, episodes: int = 10, workers: int = 1) -> list[str]:
        Path("log").write_text("")
        train = Path("out/train")
        stages.run_chains(
            [
                [
                    stages.train_stage("a policy", "train/task", Path("dataset"), train, steps),
                    stages.evaluation_stage(
                        "it", "task", stages.checkpoint(train, steps), Path("out/eval"), episodes, 0, workers=workers
                    ),
                ]
            ]
        )
        return Path("log").read_text().splitlines()

    return run


BOTH = ["train 1", "evaluate"]


def test_what_is_done_is_skipped(chain: Chain) -> None:
    assert chain() == BOTH
    assert chain() == []
    assert chain(workers=2) == [], "the number of processes changes no result"


@pytest.mark.parametrize("changed", ["configs/train/task.yaml", "dataset/meta/info.json", "dataset/meta/stats.json"])
def test_another_policy_is_evaluated_again(chain: Chain, changed: str) -> None:
    chain()
    Path(changed).write_text("second")
    Path("recipe").write_text("second")
    assert chain() == BOTH
    assert Path("out/eval/results.json").read_text() == "second"
    assert chain() == []


def test_the_same_weights_again_keep_their_evaluation(chain: Chain) -> None:
    chain()
    Path("dataset/meta/info.json").write_text("second")
    assert chain() == ["train 1"]


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_a_checkpoint_that_something_else_wrote_is_evaluated_again(chain: Chain, name: str) -> None:
    chain()
    Path(f"out/train/checkpoints/000005/pretrained_model/{name}").write_text("by hand")
    assert chain() == ["evaluate"]


def test_other_options_make_a_result_again(chain: Chain) -> None:
    chain()
    assert chain(episodes=20) == ["evaluate"]
    assert chain(steps=7, episodes=20) == BOTH


def test_results_of_unknown_origin_are_made_again(chain: Chain) -> None:
    chain()
    Path("out/eval.made_from").unlink()
    assert chain() == ["evaluate"]


def test_an_interrupted_training_starts_again_and_an_interrupted_evaluation_continues(chain: Chain) -> None:
    interrupt = Path("interrupt")
    interrupt.touch()
    with pytest.raises(SystemExit, match="lerobot-train failed with exit code 4"):
        chain()
    interrupt.unlink()
    assert chain() == BOTH
    Path("out/eval.made_from").unlink()
    interrupt.touch()
    with pytest.raises(SystemExit, match="hdril-eval failed with exit code 4"):
        chain()
    interrupt.unlink()
    assert chain() == ["evaluate"]
    assert Path("out/eval/outcomes").read_text() == "episode\nepisode\n", "the first part is there"


def test_the_rest_of_an_evaluation_of_other_weights_is_not_continued(chain: Chain) -> None:
    chain()
    weights = Path("out/train/checkpoints/000005/pretrained_model/model.safetensors")
    weights.write_text("second")
    Path("interrupt").touch()
    with pytest.raises(SystemExit):
        chain()
    weights.write_text("third")
    Path("interrupt").unlink()
    assert chain() == ["evaluate"]
    assert Path("out/eval/outcomes").read_text() == "episode\n"


# --------------------------------------------------------------------- reports


def summary(successes: int, trials: int = 100, **changes: Any) -> dict[str, Any]:
    values = {
        "first_seed": 7, "n_episodes": trials, "n_success": successes, "pc_success": 100.0 * successes / trials,
        "pc_success_ci95": [90.0, 100.0], "position_error_cm": {"mean": 0.5, "std": 0.1}, "planner_pc_correct": 99.0,
        "angle_error_rad": {"mean": 0.002, "std": 0.001},
    }  # fmt: skip
    return values | changes


def test_evaluations_are_paired_by_their_failed_seeds() -> None:
    first, second = summary(97, failed_seeds=[7, 8, 9]), summary(95, failed_seeds=[9, 10, 11, 12, 13])
    p = pairs.paired_p_value(first, second)
    assert p.exact
    assert p.value == pytest.approx(2 * (1 + 6 + 15) / 64)  # two discordant seeds against four


def test_without_seeds_the_successes_bound_p() -> None:
    all_or_nothing = pairs.paired_p_value(summary(100), summary(94))
    assert (all_or_nothing.value, all_or_nothing.exact) == (pytest.approx(2 / 64), True)
    between = pairs.paired_p_value(summary(99), summary(94))
    assert (between.value, between.exact) == (pytest.approx(2 * 8 / 128), False)  # at most one seed against six
    assert (all_or_nothing.text(0.0314), between.text(0.0314)) == ("p = 0.031", "p ≤ 0.031")
    assert between.text(0.0004) == "p < 0.001"


@pytest.mark.parametrize("changes", [{"first_seed": 8}, {"n_episodes": 101}])
def test_evaluations_on_other_seeds_are_not_paired(changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="the same seeds"):
        pairs.paired_p_value(summary(100), summary(94, **changes))


def study() -> dict[str, Any]:
    """Results of ``learning.py``: two choices, two latents."""
    point = {"steps": 100, "minutes": 0.7}
    return {
        "task": "table_lift", "commit": "abc", "cores": 2, "demonstrations": 50, "steps": 300, "seed": 7, "held_out_seed": 1,
        "few_steps": 100, "choices": 2, "few": [10], "latent_seed": 5,
        "curve": [point | summary(98), point | {"steps": 200, "minutes": 0.9} | summary(100)],
        "final": summary(100), "few_shot": {"10": [summary(100), summary(90)]},
        "latent": {
            "deterministic": {"all": summary(100), "few": [summary(100), summary(99)]},
            "variational": {"all": summary(100), "few": [summary(100), summary(60)]},
        },
    }  # fmt: skip


def test_trainings_on_the_same_seeds_are_not_pooled() -> None:
    text = learning_report.markdown(study(), "picture.png")
    assert "2 × 100: 95.0 % (90.0 to 100.0, SD 7.1)" in text
    assert "of 200" not in text
    assert "190" not in text
    assert "(picture.png)" in text
    assert "From 0.9 minutes on, 99 % or more succeed" in text


def test_latents_are_compared_training_by_training() -> None:
    text = learning_report.markdown(study(), "picture.png")
    row = next(line for line in text.splitlines() if line.startswith("| variational") and "against" in line)
    assert [cell.strip() for cell in row.strip("|").split("|")] == [
        "variational", "100 against 100, p = 1", "60 against 99, p < 0.001",
    ]  # fmt: skip
    assert "for the 2 tests of the table" in text
    assert "there are 2 pairs of them" in text


def test_the_committed_reports_are_those_of_the_committed_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for script, name in ((learning, "learning"), (presets, "presets")):
        committed = SCRIPTS.parent / "docs" / name
        (tmp_path / f"{name}.json").write_bytes(committed.with_suffix(".json").read_bytes())
        monkeypatch.setattr(sys, "argv", [name, "--report-only", f"--document={tmp_path / name}"])
        script.main()
        assert (tmp_path / f"{name}.md").read_text() == committed.with_suffix(".md").read_text()


def models(**successes: int) -> dict[str, Any]:
    """Results of ``presets.py`` with these successes, in both loops."""
    rows = {
        name: {
            "commit": "abc", "parameters": {"dynamics": 1000, "planner": 234}, "closed_loop": summary(count),
            "open_loop": summary(count),
        }
        for name, count in successes.items()
    }  # fmt: skip
    return {"task": "table_lift", "demonstrations": 9, "steps": 9, "batch_size": 9, "episodes": 100, "seed": 7,
            "presets": rows}  # fmt: skip


def test_presets_are_compared_with_ours_seed_by_seed() -> None:
    text = presets.markdown(models(res=100, int=92, hdril=100))
    tests = [line for line in text.splitlines() if "p = " in line or "p < " in line]
    assert [[cell.strip() for cell in line.strip("|").split("|")] for line in tests] == [
        ["res", "p = 1", "p = 1"], ["int", "p = 0.031", "p = 0.031"],
    ]  # fmt: skip
    assert "for the 4 tests" in text
    assert "1,234" in text
    assert "Against" not in presets.markdown(models(res=100))


def test_dtw_is_shown_only_where_every_row_has_it() -> None:
    results = models(res=100, hdril=100)
    assert "DTW, cm" not in presets.markdown(results)
    assert "awaits a new run" in presets.markdown(results)
    for row in results["presets"].values():
        row["open_loop"]["dtw_cm"] = {"mean": 0.25, "std": 0.125}
    assert "0.25 ± 0.12" in presets.markdown(results)
    assert "awaits a new run" not in presets.markdown(results)


def test_presets_need_no_configuration_of_their_own(tmp_path: Path) -> None:
    options = presets.argparse.Namespace(
        output=tmp_path, batch_size=128, steps=1500, task="table_lift", episodes=200, seed=300_000
    )
    training, *evaluations = presets.chain("res_multi", options, tmp_path / "dataset")
    assert "--config_path=configs/train/table_lift.yaml" in training.command
    assert {"--policy.preset=res_multi", "--batch_size=128", "--steps=1500"} <= set(training.command)
    assert (SCRIPTS.parent / training.inputs[0]).exists()
    assert [stage.command[-1] for stage in evaluations] == [
        "--policy.rollout=closed_loop",
        "--policy.rollout=open_loop",
    ]


def test_failed_seeds_are_kept_for_pairs(tmp_path: Path) -> None:
    results = summary(1, 2) | {
        "stages_reached": {}, "planner": {"pc_correct": 98.0}, "policy": "somewhere", "comparison": None,
        "policy_folder": "/somewhere/else",
        "per_episode": [{"seed": 7, "success": False}, {"seed": 8, "success": True}],
    }  # fmt: skip
    (tmp_path / "results.json").write_text(json.dumps(results))
    for kept in (pairs.summarise(results), learning._summary(tmp_path)):
        assert kept["failed_seeds"] == [7]
        assert "per_episode" not in kept
        assert "policy" not in kept
        assert "policy_folder" not in kept, "a path of one machine"
