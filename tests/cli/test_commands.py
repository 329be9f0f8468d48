"""The commands as a user types them: stock LeRobot around our dataset, policy and tasks, and one-line refusals."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import draccus
import pytest
from lerobot.configs.train import TrainPipelineConfig
from lerobot_policy_hdril import HDRILConfig
from lerobot_policy_hdril.presets import PRESETS

BIN = Path(sys.executable).parent
REPO = Path(__file__).parents[2]


def call(*arguments: object, timeout: float = 400) -> subprocess.CompletedProcess[str]:
    command = [str(BIN / str(arguments[0])), *map(str, arguments[1:])]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, cwd=REPO, check=False)


def succeed(*arguments: object) -> str:
    done = call(*arguments)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


def train(dataset: Path, output: Path, *more: str) -> str:
    return succeed(
        "lerobot-train", "--config_path=configs/train/table_lift.yaml", f"--dataset.root={dataset}",
        f"--output_dir={output}", "--batch_size=16", "--num_workers=0", "--log_freq=1", *more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def checkpoint(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """HDR-IL after two steps of stock ``lerobot-train``."""
    output = tmp_path_factory.mktemp("hdril") / "train"
    train(dataset, output, "--steps=2", "--save_freq=2")
    return output / "checkpoints" / "last" / "pretrained_model"


def test_each_preset_has_a_config_and_they_differ_in_nothing_else() -> None:
    files = {path.stem: path for path in (REPO / "configs/presets").glob("*.yaml")}
    assert set(files) == set(PRESETS)
    rest = []
    for name, path in files.items():
        config = draccus.parse(TrainPipelineConfig, path, args=[])
        assert isinstance(config.policy, HDRILConfig)
        assert config.policy.preset == config.job_name == name
        assert config.output_dir == Path("outputs/table_lift") / name
        rest.append(dataclasses.replace(config, policy=None, job_name=None, output_dir=None))
    assert all(one == rest[0] for one in rest)


def test_training_resumes(checkpoint: Path) -> None:
    text = succeed("lerobot-train", f"--config_path={checkpoint / 'train_config.json'}", "--resume=true", "--steps=4")
    assert "step:4" in text
    assert "step:1 " not in text
    assert (checkpoint.parents[1] / "000004" / "pretrained_model" / "model.safetensors").exists()


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
    ("policy", "options"),
    [
        ("act", ["--policy.dim_model=64", "--policy.n_heads=2", "--policy.dim_feedforward=64"]),
        ("diffusion", ["--policy.down_dims=[32,64,128]", "--policy.num_inference_steps=3"]),
    ],
)
def test_lerobots_own_policies_train_and_evaluate(policy: str, options: list, dataset: Path, tmp_path: Path) -> None:
    """State only, nothing changed in either."""
    succeed(
        "lerobot-train", f"--policy.type={policy}", "--policy.device=cpu", "--policy.push_to_hub=false", *options,
        "--dataset.repo_id=hdril/test", f"--dataset.root={dataset}", f"--output_dir={tmp_path / 'train'}",
        "--batch_size=4", "--num_workers=0", "--steps=2", "--save_freq=2", "--env_eval_freq=0",
    )  # fmt: skip
    trained = tmp_path / "train/checkpoints/last/pretrained_model"
    succeed("hdril-eval", f"--policy.path={trained}", "--num_episodes=1", "--seed=200000", "--workers=1",
            f"--output_dir={tmp_path / 'eval'}")  # fmt: skip
    results = json.loads((tmp_path / "eval/results.json").read_text())
    assert results["n_episodes"] == 1
    assert results["pc_expert_order"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["hdril-record", "--repo_id=a/b", "--task=chess"], "unknown task 'chess'; choose from: "),
        (["hdril-record", "--repo-id=a/b", "--num-episodes=0"], "num_episodes must be at least 1, got 0"),
        (["hdril-record", "--repo_id=nameless"], "repo_id must look like user/name, got 'nameless'"),
        (["hdril-record", "--repo_id=nameless", "--push"], "repo_id must look like user/name, got 'nameless'"),
        (["hdril-eval", "--policy.path=x/y", "--push=nameless"], "push must look like user/name, got 'nameless'"),
        (["hdril-record", "--repo_id=a/b", "--noise.waypoint=1"], "noise.waypoint must be from 0 to 0.02 m"),
        (["hdril-record", "--repo_id=a/b", "--colour=red"], "--colour"),
        (["hdril-eval", "--policy.path=no/such/place"], "no checkpoint at no/such/place"),
        (["hdril-eval", "--policy.path=x/y", "--task=chess"], "unknown task 'chess'; choose from: "),
        (["hdril-eval", "--policy.path=x/y", "--num_episodes=0"], "num_episodes must be at least 1, got 0"),
        (["hdril-eval", "--policy.path=x/y", "--rerun=some"], "rerun must be failures, all, none or a number"),
    ],
)
def test_refusals_are_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    where = [f"--root={tmp_path / 'out'}"] if arguments[0] == "hdril-record" else [f"--output_dir={tmp_path / 'out'}"]
    done = call(*arguments, *where)
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"{arguments[0]}: error: ")
    assert message in last
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "option"),
    [("hdril-record", "--task"), ("hdril-eval", "--task"), ("hdril-bench", "--task"), ("hdril-view", "--against")],
)
def test_help(command: str, option: str) -> None:
    text = succeed(command, "--help")
    assert option in text
    assert "Traceback" not in text


def test_ctrl_c_stops_cleanly_and_the_same_command_goes_on(tmp_path: Path) -> None:
    root = tmp_path / "set"
    command = [str(BIN / "hdril-record"), "--repo_id=a/b", f"--root={root}", "--num_episodes=4", "--workers=2"]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("set.partial/*.npz")) and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Run the same command again to go on" in out
    assert not root.exists()
    text = succeed(*[Path(command[0]).name, *command[1:]])
    assert "4 episodes (seeds 0 to 3)" in text
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
