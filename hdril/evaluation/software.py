"""Which software decides results: versions, and digests of sources that change without one."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import hdril
from hdril.digest import SHORT, digest_file, digest_files
from hdril.simulation.robots import ROBOTS
from hdril.tasks import TASKS

_EPISODE = ("actor.py", "env.py", "geometry.py", "rollout.py", "simulation", "tasks", "trace.py")
_SCORES = (
    *_EPISODE, "evaluation/evaluate.py", "evaluation/lerobot_actor.py", "evaluation/metrics.py",
    "evaluation/reference.py", "evaluation/score.py",
)  # fmt: skip


def _sources(root: Path, parts: Iterable[str]) -> list[Path]:
    """Python files of ``parts`` of a package, each a file or a folder, in a fixed order."""
    paths = [root / part for part in parts]
    return [file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]


def distribution_version(name: str) -> str:
    """Version of an installed distribution; ``unknown`` if there is none of that name."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


@cache
def _source_digest(parts: tuple[str, ...]) -> str:
    return digest_files(_sources(Path(hdril.__file__).parent, parts))[:SHORT]


@cache
def _robot_model(robot: str) -> str:
    model = digest_file(ROBOTS[robot].source())[:SHORT]
    return f"{robot} of example-robot-data {distribution_version('example-robot-data')} ({model})"


def _task_source(task: str) -> dict[str, str]:
    """Digest of the module of a task from another package; the sources of this one have their own."""
    module = TASKS.source(task)
    if getattr(module, "__name__", "").startswith(f"{hdril.__name__}.") or not getattr(module, "__file__", None):
        return {}
    return {f"source of {task}": digest_file(Path(module.__file__))[:SHORT]}


def episode_software(task: str, robot: str = "baxter") -> dict[str, str]:
    """What decides an episode of given actions on a task (its name without parameters): the scene, and how it goes on."""
    return {
        "hdril": f"{hdril.__version__} ({_source_digest(_EPISODE)})",
        "pybullet": distribution_version("pybullet"),
        "numpy": distribution_version("numpy"),
        "scipy": distribution_version("scipy"),
        "robot model": _robot_model(robot),
    } | _task_source(task)


def evaluation_software(task: str, robot: str = "baxter") -> dict[str, str]:
    """What decides scenes, the expert's episodes and scores: the same for any policy."""
    scores = {"hdril": f"{hdril.__version__} ({_source_digest(_SCORES)})"}
    return episode_software(task, robot) | scores | {"dtaidistance": distribution_version("dtaidistance")}


def policy_software(policy_class: type) -> dict[str, str]:
    """What decides a policy's actions, its weights aside: torch, LeRobot, and the package that defines the policy."""
    software = {"lerobot": distribution_version("lerobot"), "torch": distribution_version("torch")}
    package = policy_class.__module__.partition(".")[0]
    if package not in software:
        software[package] = f"{distribution_version(package)} ({_package_digest(package)})"
    return software


@cache
def _package_digest(package: str) -> str:
    """Digest of a package's Python files: one that is installed in place changes without a new version."""
    from importlib.util import find_spec

    spec = find_spec(package)
    places = list(spec.submodule_search_locations or []) if spec else []
    if not places:
        return digest_file(Path(spec.origin))[:SHORT] if spec and spec.origin else "unknown"
    return digest_files(_sources(Path(places[0]), ["."]))[:SHORT]
