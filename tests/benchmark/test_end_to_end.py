"""The whole benchmark, with its real commands: recorded, trained and evaluated, killed on the way, and reported."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from hdril.benchmark.page import read_numbers

ROOT = Path(__file__).parents[2]
MATRIX = """
name: small
data:
  lift: {task: table_lift, episodes: 3}
policies:
  linear: {steps: 2, options: [--policy.preset=linear, --batch_size=8]}
  nearest: {steps: 2, config: configs/train/hard.yaml, options: [--policy.type=nearest, --batch_size=8]}
evaluations:
  lift: {task: table_lift, episodes: 3, seed: 600000}
tables:
  - {title: Lift, data: [lift], policies: [linear, nearest], evaluations: [lift], demonstrations: [2, 3], against: linear}
"""


def numbers(report: Path) -> Any:
    """A report without what depends on the machine's speed, and on where it was made."""
    (table,) = read_numbers(report)["tables"]
    del table["made"]
    for row in table["rows"]:
        del row["training_minutes"]
        for run in (run for runs in row["cells"].values() for run in runs):
            del run["digest"]  # of a file that says where the policy is
            for step in (run, *run["made_from"].values()):
                del step["seconds"]
    return table


def start(config: Path, folder: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "hdril.cli.benchmark", f"--config_path={config}", f"--store={folder / 'store'}",
               f"--document={folder / 'report'}", "--jobs=2"]  # fmt: skip
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_killed_five_times_it_ends_with_the_same_numbers(tmp_path: Path) -> None:
    config = tmp_path / "small.yaml"
    config.write_text(MATRIX)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    process = start(config, whole)
    begun = time.monotonic()
    _, told = process.communicate()
    assert process.returncode == 0, told.decode()
    took = time.monotonic() - begun
    rng = random.Random(11)
    for _ in range(5):
        process = start(config, killed)
        time.sleep(rng.uniform(0.1, 0.5) * took)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    process = start(config, killed)
    _, told = process.communicate()
    assert process.returncode == 0, told.decode()
    assert numbers(killed / "report") == numbers(whole / "report")
    text = (killed / "report.md").read_text()
    assert "| `nearest` | lift         | 2  " in text
    assert text.count("hdril-record --task=table_lift --num_episodes=2") == 1
