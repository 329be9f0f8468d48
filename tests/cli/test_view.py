"""hdril-view as a user runs it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from tests.cli.commands import refuse, succeed
from tests.evaluation.checkpoints import listing


@pytest.mark.portable
def test_replay_and_comparison_are_of_the_evaluated_weights(checkpoint: Path, tmp_path: Path) -> None:
    """A seed is played again with the weights that were evaluated, and with no others."""
    last = Path(shutil.copytree(checkpoint, tmp_path / "last"))
    run = tmp_path / "eval"
    evaluated = [
        "hdril-eval",
        f"--policy.path={last}",
        "--seed=200000",
        "--num_episodes=1",
        "--workers=1",
        "--rerun=none",
    ]
    succeed(*evaluated, f"--output_dir={run}")
    text = succeed("hdril-view", f"--run={run}", "--seed=200000", f"--save={tmp_path / 'again.rrd'}")
    assert "Seed 200000 was not recorded: playing it again" in text
    assert "may differ" not in text
    assert (tmp_path / "again.rrd").stat().st_size > 100_000
    weights = load_file(last / "model.safetensors")
    weights["output_mean"] += 1e-3
    save_file(weights, last / "model.safetensors")
    before = listing(tmp_path)
    for more in ([], [f"--against={run}"]):
        message = refuse("hdril-view", f"--run={run}", "--seed=200000", *more, f"--save={tmp_path / 'other.rrd'}")
        assert message.startswith(f"{run} holds results of other weights (")
        assert message.endswith(f"the checkpoint {last} is no longer the one that was evaluated")
    assert listing(tmp_path) == before


def test_a_folder_without_results_is_named(tmp_path: Path) -> None:
    message = refuse("hdril-view", f"--run={tmp_path}")
    assert message == f"{tmp_path} holds no results.json: give the output_dir of a finished hdril-eval"


def test_damaged_results_are_named(tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text('{"task": "table')
    assert refuse("hdril-view", f"--run={tmp_path}").startswith(f"{tmp_path / 'results.json'} is not valid JSON: ")
