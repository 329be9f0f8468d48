"""The tutorials' own files, as a reader runs them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as parquet
import pytest

from hdril.tasks.scenario import Scenario

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
    return install(TUTORIALS / "own_task", tmp_path_factory.mktemp("package"))


def install(source: Path, folder: Path) -> Path:
    """Build a package and install it into a folder for PYTHONPATH."""
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


def follow(page: str, folder: Path) -> None:
    """Make the changes of a how-to page: its blocks of code come in pairs, the old lines and the new ones."""
    text = (ROOT / "docs/how-to" / page).read_text()
    blocks = re.findall(r"```{code-block} (python|toml)\n(.*?)\n```", text, re.DOTALL)
    assert len(blocks) >= 4
    assert len(blocks) % 2 == 0
    for (kind, old), (_, new) in zip(blocks[::2], blocks[1::2], strict=True):
        path = folder / {"python": "trestle_shift.py", "toml": "pyproject.toml"}[kind]
        source = path.read_text()
        assert source.count(old) == 1, old
        path.write_text(source.replace(old, new))


@pytest.fixture(scope="module")
def varied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package after both pages were followed."""
    folder = tmp_path_factory.mktemp("varied")
    shutil.copytree(TUTORIALS / "own_task", folder / "own_task")
    follow("add_a_factor.md", folder / "own_task")
    follow("add_an_event.md", folder / "own_task")
    return install(folder / "own_task", folder)


@pytest.mark.parametrize("event", ["push", "jolt"])
def test_a_factor_and_an_event_are_added_word_for_word(varied: Path, tmp_path: Path, event: str) -> None:
    command = [Path(sys.executable).with_name("hdril-record"), "--task=trestle_shift:mass=1.5", "--root=data",
               f"--events={event}=1", "--num_episodes=3", "--workers=1"]  # fmt: skip
    _run(command, tmp_path, PYTHONPATH=str(varied))
    rows = parquet.read_table(next((tmp_path / "data/meta/episodes").rglob("*.parquet"))).to_pandas()
    scenarios = [Scenario.from_json(text) for text in rows["scenario"]]
    masses = [scenario.values["mass"] for scenario in scenarios]
    assert len(set(masses)) == 3
    assert all(1 / 1.5 <= mass <= 1.5 for mass in masses)
    assert all([happened.name for happened in scenario.events] == [event] for scenario in scenarios)


def test_a_kind_of_event_from_another_package_acts(varied: Path, tmp_path: Path) -> None:
    code = (
        "from hdril.env import BimanualEnv; from hdril.tasks.events import Event; from dataclasses import replace\n"
        "env = BimanualEnv('trestle_shift'); seen = env.reset(seed=0)[0]\n"
        "event = Event('up', 'lift_off', 1, 1, 'trestle', (-1.5, 2.0, 0.0))\n"
        "seen = env.reset(seed=0, options={'scenario': replace(env.scenario, events=(event,))})[0]\n"
        "infos = [env.step(seen['agent_pos'])[4] for _ in range(2)]\n"
        "print(repr(infos[1]['events']), infos[1]['trestle_height_m'] > 0.01)"
    )
    printed = _run([sys.executable, "-c", code], tmp_path, PYTHONPATH=str(varied))
    assert printed.strip().splitlines()[-1] == "'up: trestle (2.50 N s)' True"


def test_gymnasium_knows_the_task(package: Path, tmp_path: Path) -> None:
    code = "import gymnasium, hdril; print(gymnasium.make('hdril/TrestleShift-v0').unwrapped.task)"
    assert _run([sys.executable, "-c", code], tmp_path, PYTHONPATH=str(package)).strip().endswith("trestle_shift")
