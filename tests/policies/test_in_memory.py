"""Frames in memory give the batches that LeRobot's own loader gives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets.io_utils import hf_transform_to_torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot_policy_hdril.in_memory import FramesInMemory, hold
from torch.utils.data import DataLoader, default_collate

from datasets import Dataset
from tests.cli.commands import succeed

WINDOWS = {
    "single frames": None,
    "ACT": {"action": [i / 10 for i in range(20)]},
    "Diffusion": {
        "action": [i / 10 for i in range(-1, 15)],
        "observation.state": [-0.1, 0.0],
        "observation.environment_state": [-0.1, 0.0],
    },
}


@pytest.mark.parametrize("windows", WINDOWS)
@pytest.mark.parametrize("episodes", [None, [1, 4]], ids=["all episodes", "two episodes"])
def test_frames_are_the_same(windows: str, episodes: list[int] | None, dataset: Path) -> None:
    """Windows that reach over the ends of an episode are among them."""
    stock, held = (
        LeRobotDataset("local/test", root=dataset, episodes=episodes, delta_timestamps=WINDOWS[windows])
        for _ in range(2)
    )
    held = hold(held)
    assert isinstance(held.hf_dataset, FramesInMemory)
    assert len(held) == len(stock)
    for i in {0, 1, 10, 75, len(stock) - 1}:
        assert_same(held[i], stock[i])
    rows = list(range(0, len(stock), 37))
    assert_same(default_collate([held[i] for i in rows]), default_collate([stock[i] for i in rows]))


def assert_same(first: dict[str, Any], second: dict[str, Any]) -> None:
    assert list(first) == list(second)
    for name, value in second.items():
        if isinstance(value, torch.Tensor):
            assert first[name].dtype == value.dtype, name
            torch.testing.assert_close(first[name], value, rtol=0.0, atol=0.0)
        else:
            assert first[name] == value, name


def test_frames_go_to_the_workers_of_a_loader(dataset: Path) -> None:
    held = hold(LeRobotDataset("local/test", root=dataset, delta_timestamps=WINDOWS["ACT"]))
    expected = default_collate([held[i] for i in range(4)])
    loader = DataLoader(held, batch_size=4, num_workers=1, multiprocessing_context="spawn")
    assert_same(next(iter(loader)), expected)


def test_numbers_are_held_and_other_columns_stay_on_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Dataset.from_dict({"x": [0.5, 1.5], "words": ["a", "b"], "many": [[1, 2], [3, 4]]})
    table.set_transform(hf_transform_to_torch)
    frames = FramesInMemory(table)
    assert frames[1]["words"] == "b"
    assert frames[[1, 0]]["words"] == ["b", "a"]
    assert frames["words"][[1]] == ["b"]
    assert frames[1]["many"].tolist() == [3, 4]
    numbers = FramesInMemory(table.select_columns(["x", "many"]))
    monkeypatch.setattr(Dataset, "__getitem__", None)  # reading from disk would fail
    assert numbers[0]["x"] == 0.5
    assert [row.tolist() for row in numbers[[1, 0]]["many"]] == [[3, 4], [1, 2]]
    assert frames["x"][[1, 0]] == [1.5, 0.5]


def test_training_ends_with_the_weights_of_stock_training(dataset: Path, tmp_path: Path) -> None:
    options = ["--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.dim_model=32",
               "--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.chunk_size=8", "--policy.n_action_steps=8",
               "--dataset.repo_id=hdril/test", f"--dataset.root={dataset}", "--batch_size=4", "--num_workers=0", "--steps=2",
               "--save_freq=2", "--env_eval_freq=0", "--seed=3"]  # fmt: skip
    succeed("lerobot-train", *options, f"--output_dir={tmp_path / 'stock'}")
    succeed("python", "-m", "lerobot_policy_hdril.in_memory", *options, f"--output_dir={tmp_path / 'held'}")
    model = "checkpoints/last/pretrained_model/model.safetensors"
    assert (tmp_path / "held" / model).read_bytes() == (tmp_path / "stock" / model).read_bytes()
    steps = json.loads((tmp_path / "held/checkpoints/last/training_state/training_step.json").read_text())
    assert steps["step"] == 2
