"""hdril-eval and lerobot-eval as a user runs them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from tests.cli.commands import call, succeed


def test_hdril_evaluates_with_both_commands(checkpoint: Path, tmp_path: Path) -> None:
    succeed(
        "lerobot-eval", f"--policy.path={checkpoint}", "--env.type=hdril", "--env.task=table_lift",
        "--eval.n_episodes=1", "--eval.batch_size=1", "--seed=200000", f"--output_dir={tmp_path / 'stock'}",
    )  # fmt: skip
    stock = json.loads((tmp_path / "stock/eval_info.json").read_text())
    assert stock["per_task"][0]["metrics"]["successes"] == [False]
    assert list((tmp_path / "stock").rglob("*.mp4"))
    out = tmp_path / "ours"
    text = succeed(
        "hdril-eval", f"--policy.path={checkpoint}", "--num_episodes=2", "--seed=200000", "--rerun=1", "--workers=2",
        f"--output_dir={out}", "--policy.rollout=open_loop",
    )  # fmt: skip
    results = json.loads((out / "results.json").read_text())
    assert results["n_success"] == 0
    assert results["held_out"] is True
    assert results["overrides"] == ["--rollout=open_loop"]
    assert len(results["per_episode"]) == 2
    assert [path.name for path in (out / "rerun").iterdir()] == ["seed_0200000_failure.rrd"]
    assert "0 of 2 succeeded" in text
    done = call("hdril-eval", f"--policy.path={checkpoint}", f"--output_dir={out}")
    assert done.returncode == 2
    assert "ours exists" in done.stderr
    done = call("hdril-eval", f"--policy.path={checkpoint}", "--seed=3", f"--output_dir={tmp_path / 'no'}")
    assert done.returncode == 2
    assert "were in the training data" in done.stderr
    assert not (tmp_path / "no").exists()
    done = call(
        "hdril-eval", f"--policy.path={checkpoint}", "--policy.replan_every=6", f"--output_dir={tmp_path / 'no'}"
    )
    assert done.returncode == 2
    assert "replan_every must be 0, because the checkpoint was trained with 0; got 6" in done.stderr
    assert not (tmp_path / "no").exists()


def test_an_action_that_is_not_finite_is_named(checkpoint: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    broken = Path(shutil.copytree(checkpoint, tmp_path / "broken"))
    weights = load_file(broken / "model.safetensors")
    weights["output_mean"][0] = float("nan")
    save_file(weights, broken / "model.safetensors")
    done = call(
        "hdril-eval", f"--policy.path={broken}", "--seed=200000", "--workers=2", f"--output_dir={tmp_path / 'out'}"
    )
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1] == "hdril-eval: error: the action is not finite: left_ee.x = nan"
    assert list(tmp_path.iterdir()) == [broken]
