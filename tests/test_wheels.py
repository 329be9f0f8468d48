"""The two wheels, in an environment outside the checkout that holds them, the packages that they declare, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
PROJECTS = {"hdril": ROOT, "lerobot_policy_hdril": ROOT / "policies/lerobot_policy_hdril"}

# `make setup` fills uv's cache, and then an environment takes a second. With an empty cache, uv downloads the packages and
# compiles PyBullet, which takes minutes.
pytestmark = pytest.mark.timeout(1500)

IMPORT_EVERYTHING = """
import importlib, pkgutil
for package in map(importlib.import_module, ("hdril", "lerobot_policy_hdril")):
    print(package.__file__)
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        print(importlib.import_module(found.name).__file__)
"""

LOAD_A_CHECKPOINT = """
import importlib.util, sys
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

assert importlib.util.find_spec("hdril") is None and importlib.util.find_spec("pybullet") is None
register_third_party_plugins()
checkpoint, dataset = sys.argv[1:]
config = PreTrainedConfig.from_pretrained(checkpoint)
policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
before, after = make_pre_post_processors(config, pretrained_path=checkpoint)
frame = LeRobotDataset("hdril/wheels", root=dataset)[0]
policy.reset()
action = after(policy.select_action(before({key: frame[key] for key in config.input_features})))
print(config.type, tuple(action.shape), bool(torch.isfinite(action).all()))
"""


def _run(command: list[str | Path], cwd: Path, **environment: str) -> str:
    """Output of a command that must succeed, without what leads Python back to this environment or to the user's files."""
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV", "PYTEST"))
    }
    done = subprocess.run(command, cwd=cwd, env=kept | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The wheel of each distribution."""
    folder = tmp_path_factory.mktemp("wheels")
    for project in PROJECTS.values():
        _run([sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", folder, project], cwd=folder)
    return {name: next(folder.glob(f"{name}-*.whl")) for name in PROJECTS}


def _uv(*arguments: str | Path) -> None:
    """Run uv in the checkout, whose [tool.uv] says how PyBullet is built: from its cache if all is there."""
    try:
        _run([BIN / "uv", *arguments, "--quiet", "--offline"], cwd=ROOT)
    except AssertionError:
        _run([BIN / "uv", *arguments, "--quiet"], cwd=ROOT)


def _install(environment: Path, *wheels: Path) -> None:
    """Make an environment hold ``wheels`` and what they declare, in the versions that are pinned, and nothing else."""
    wanted, pinned = environment.with_suffix(".in"), environment.with_suffix(".txt")
    wanted.write_text("\n".join(f"{wheel.name.split('-')[0]} @ {wheel.as_uri()}" for wheel in wheels))
    _uv("pip", "compile", wanted, "--constraint", "requirements.txt", "--output-file", pinned)
    _uv("pip", "sync", "--python", environment / "bin/python", pinned)


@pytest.fixture(scope="module")
def workplace(wheels: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder outside the checkout with an environment that holds both wheels."""
    folder = tmp_path_factory.mktemp("workplace")
    _uv("venv", "--python", sys.executable, folder / "env")
    _install(folder / "env", *wheels.values())
    return folder


def _program(workplace: Path, name: str, *arguments: str) -> str:
    """Output of a program of the environment, run in the folder, with a home of its own."""
    program = workplace / "env/bin" / name
    return _run([program, *arguments], workplace, HOME=str(workplace), HF_HUB_OFFLINE="1", OMP_NUM_THREADS="1")


def test_wheels_declare_what_they_need_and_work_from_any_folder(workplace: Path, wheels: dict[str, Path]) -> None:
    import pyarrow.parquet as parquet

    imported = _program(workplace, "python", "-c", IMPORT_EVERYTHING).splitlines()
    assert all(Path(file).is_relative_to(workplace / "env") for file in imported)
    modules = [*(ROOT / "hdril").rglob("*.py"), *(PROJECTS["lerobot_policy_hdril"] / "src").rglob("*.py")]
    assert len(imported) == len(modules)

    _program(workplace, "hdril-record", "--repo_id=hdril/wheels", "--root=data", "--num_episodes=2", "--workers=1")
    episodes = parquet.read_table(next((workplace / "data/meta/episodes").rglob("*.parquet")))
    assert episodes["seed"].to_pylist() == [0, 1]

    # Installed beside the simulator, the policy trains; alone, it loads.
    _program(
        workplace, "lerobot-train", "--dataset.repo_id=hdril/wheels", "--dataset.root=data", "--policy.type=hdril",
        "--policy.device=cpu", "--policy.push_to_hub=false", "--output_dir=train", "--steps=2", "--batch_size=8",
        "--num_workers=0", "--env_eval_freq=0", "--wandb.enable=false",
    )  # fmt: skip
    _install(workplace / "env", wheels["lerobot_policy_hdril"])
    checkpoint = "train/checkpoints/last/pretrained_model"
    printed = _program(workplace, "python", "-c", LOAD_A_CHECKPOINT, checkpoint, "data")
    assert printed.splitlines()[-1] == "hdril (1, 16) True"
