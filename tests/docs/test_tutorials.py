"""The tutorials' own files, as a reader runs them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as parquet
import pytest

ROOT = Path(__file__).parents[2]
TUTORIALS = ROOT / "docs/tutorials"


def _run(command: list[str | Path], cwd: Path, **environment: str) -> str:
    done = subprocess.run(command, cwd=cwd, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_library_tutorial_runs(tmp_path: Path) -> None:
    printed = _run([sys.executable, TUTORIALS / "library.py", tmp_path / "out"], tmp_path)
    assert "success: True, after 70 frames; the table rose to 18 cm" in printed
    assert "recorded the seeds (0, 1, 2, 3, 4, 5)" in printed
    loss = next(line for line in printed.splitlines() if line.startswith("loss:")).split()
    first, last = float(loss[1]), float(loss[4])
    assert last < 0.7 * first
    assert "seed 100001: success" in printed


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for PYTHONPATH with the package of the tutorial, built and installed."""
    folder = tmp_path_factory.mktemp("package")
    source = TUTORIALS / "own_task"
    _run([sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", folder / "wheels", source], folder)
    wheel = next((folder / "wheels").glob("*.whl"))
    uv = Path(sys.executable).with_name("uv")
    _run([uv, "pip", "install", "--quiet", "--offline", "--no-deps", "--target", folder / "site", wheel], folder)
    return folder / "site"


def test_a_task_from_another_package_is_recorded(package: Path, tmp_path: Path) -> None:
    command = [Path(sys.executable).with_name("hdril-record"), "--task=trestle_shift:height=0.14", "--root=data",
               "--num_episodes=3", "--workers=1"]  # fmt: skip
    printed = _run(command, tmp_path, PYTHONPATH=str(package))
    assert "0 of 3 dropped" in printed
    names = parquet.read_table(tmp_path / "data/meta/subtasks.parquet").to_pandas().index
    assert list(names) == ["grasp", "lift", "extend", "place", "retract"]
    data = parquet.read_table(next((tmp_path / "data/data").rglob("*.parquet"))).to_pandas()
    # The parameter acts: the trestle ends at the height of the step.
    for _, episode in data.groupby("episode_index"):
        _, _, z, *_ = episode["observation.environment_state"].iloc[-1]
        assert abs(z - 0.14) < 0.01


def test_gymnasium_knows_the_task(package: Path, tmp_path: Path) -> None:
    code = "import gymnasium, hdril; print(gymnasium.make('hdril/TrestleShift-v0').unwrapped.task)"
    assert _run([sys.executable, "-c", code], tmp_path, PYTHONPATH=str(package)).strip().endswith("trestle_shift")
