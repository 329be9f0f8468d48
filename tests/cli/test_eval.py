"""hdril-eval and lerobot-eval as a user runs them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hdril.cli.eval
from tests.cli.commands import call, refuse, start, succeed
from tests.evaluation.checkpoints import listing


@pytest.mark.portable
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--policy.bogus=7"], "hdril has no option policy.bogus; it has: "),
        (["--policy.rollout=backwards"], "argument policy.rollout: invalid choice: 'backwards'"),
        (
            ["--policy.hidden_dim=64"],
            "policy.hidden_dim cannot change an evaluation; "
            "what can: experts, least_survival, repeat_discount, replan_every, rollout, samples",
        ),
        (["--policy.repo_id=a/b"], "policy.repo_id cannot change an evaluation; what can: "),
        (["--max_frames=69"], "max_frames must be at least 70, the horizon of table_lift"),
        (["--seed=5"], "1 of 1 seeds (5 to 5) were in the training data"),
        (["--task=peg_in_hole"], "the policy was trained on the task table_lift, not on peg_in_hole"),
        (["--training_data=elsewhere"], "records what it was trained on: leave out training_data"),
        (["--against=elsewhere"], "elsewhere holds no results.json"),
    ],
)
def test_refusals_leave_nothing(
    checkpoint: Path, tmp_path: Path, options: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """The folder of the results and those above it are not made, either."""
    given = ["--seed=200000", "--num_episodes=1", "--workers=1", *options]
    output = f"--output_dir={tmp_path / 'new/folders/eval'}"
    monkeypatch.setattr(sys, "argv", ["hdril-eval", f"--policy.path={checkpoint}", *given, output])
    with pytest.raises(SystemExit) as caught:
        hdril.cli.eval.main()
    assert caught.value.code == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("hdril-eval: error: ")
    assert message in last
    assert listing(tmp_path) == {}


def test_a_truncated_checkpoint_is_one_line(checkpoint: Path, tmp_path: Path) -> None:
    broken = Path(shutil.copytree(checkpoint, tmp_path / "broken"))
    weights = broken / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    message = refuse("hdril-eval", f"--policy.path={broken}", f"--output_dir={tmp_path / 'out'}")
    assert message.startswith(f"{weights} is not a whole safetensors file: download or save it again")
    assert list(tmp_path.iterdir()) == [broken]


def test_ctrl_c_stops_and_the_same_command_goes_on(checkpoint: Path, tmp_path: Path) -> None:
    command = ["hdril-eval", f"--policy.path={checkpoint}", "--seed=200000", "--num_episodes=6", "--workers=1",
               "--rerun=none", f"--output_dir={tmp_path / 'eval'}"]  # fmt: skip
    journal = tmp_path / "eval.partial/outcomes.jsonl"
    process = start(*command, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 200
    while not (journal.exists() and journal.read_text()) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=120) == 130
    played = journal.read_text()
    assert 1 <= len(played.splitlines()) < 6
    succeed(*command)
    results = json.loads((tmp_path / "eval/results.json").read_text())
    assert [episode["seed"] for episode in results["per_episode"]] == list(range(200_000, 200_006))
    assert results["per_episode"][0] == json.loads(played.splitlines()[0])
    assert [path.name for path in tmp_path.iterdir()] == ["eval"]
    assert not {"run.json", "outcomes.jsonl", "lock"} & {path.name for path in (tmp_path / "eval").iterdir()}


def test_help_says_what_is_checked() -> None:
    text = " ".join(succeed("hdril-eval", "--help").split())
    for words in ("--max_frames", "--against", "--training_data", "Seeds that the policy was trained on are refused"):
        assert words in text
