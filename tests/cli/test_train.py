"""Stock ``lerobot-train`` with our dataset: HDR-IL, and LeRobot's own policies."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.commands import succeed


def test_training_resumes(checkpoint: Path) -> None:
    text = succeed("lerobot-train", f"--config_path={checkpoint / 'train_config.json'}", "--resume=true", "--steps=4")
    assert "step:4" in text
    assert "step:1 " not in text
    assert (checkpoint.parents[1] / "000004" / "pretrained_model" / "model.safetensors").exists()


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
