"""Which software decides results: versions, and digests of sources that change without one."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path

import hdril
from hdril.digest import SHORT, digest_file, digest_files
from hdril.simulation.robots import ROBOTS

_EPISODE = ("actor.py", "env.py", "geometry.py", "rollout.py", "simulation", "tasks", "trace.py")
_SCORES = (
    *_EPISODE, "evaluation/evaluate.py", "evaluation/lerobot_actor.py", "evaluation/metrics.py",
    "evaluation/mishap.py", "evaluation/motion.py", "evaluation/reference.py", "evaluation/score.py",
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
    """Digest of the package that a task's entry point names; the tasks of hdril are in the digest of hdril.

    Raises:
        ValueError: the files of the package cannot be read.
    """
    claims = entry_points(group="hdril.tasks", name=task)
    return {f"source of {task}": _plugin_digest(task, claim.module) for claim in claims}


@cache
def _plugin_digest(task: str, module: str) -> str:
    try:
        return digest_files(_package_files(module))[:SHORT]
    except OSError:
        raise ValueError(
            f"the task {task!r} comes from {module}, whose files cannot be read: no record could tell which task it was"
        ) from None


def _package_files(module: str) -> list[Path]:
    """The files of the outermost package that holds a module, without bytecode; the module's own if it is in none.

    All of them count, because a scene may be made of meshes and tables of numbers, too. Namespace packages are passed over:
    they belong to several distributions.

    Raises:
        FileNotFoundError: there are no files, such as for a package in an archive.
    """
    names = accumulate(module.split("."), "{}.{}".format)
    specs = (spec for spec in map(find_spec, names) if spec is not None)
    origin, is_package = next(
        ((spec.origin, bool(spec.submodule_search_locations)) for spec in specs if spec.origin), ("", False)
    )
    if not Path(origin).is_file():
        raise FileNotFoundError(origin)
    files = sorted(Path(origin).parent.rglob("*")) if is_package else [Path(origin)]
    return [file for file in files if file.is_file() and file.suffix != ".pyc"]


def episode_software(task: str, robot: str = "baxter") -> dict[str, str]:
    """What decides an episode of given actions on a task (its name without parameters): the scene, and how it goes on."""
    return (
        source_software(*_EPISODE)
        | {
            "pybullet": distribution_version("pybullet"),
            "numpy": distribution_version("numpy"),
            "scipy": distribution_version("scipy"),
            "robot model": _robot_model(robot),
        }
        | _task_source(task)
    )


def evaluation_software(task: str, robot: str = "baxter") -> dict[str, str]:
    """What decides scenes, the expert's episodes and scores: the same for any policy."""
    scores = source_software(*_SCORES)
    return episode_software(task, robot) | scores | {"dtaidistance": distribution_version("dtaidistance")}


def source_software(*parts: str) -> dict[str, str]:
    """Version of hdril, with the digest of some of its sources: files and folders, by their path in the package."""
    return {"hdril": f"{hdril.__version__} ({_source_digest(parts)})"}


def recording_software(task: str, robot: str = "baxter") -> dict[str, str]:
    """What decides a recorded dataset of a task: episodes, their noise and labels, columns and statistics."""
    libraries = {name: distribution_version(name) for name in ("lerobot", "pyarrow")}
    return episode_software(task, robot) | source_software(*_EPISODE, "demonstrations") | libraries


def policy_software(policy_class: type) -> dict[str, str]:
    """What decides a policy's actions, its weights aside: torch, LeRobot, and the package that defines the policy."""
    software = {"lerobot": distribution_version("lerobot"), "torch": distribution_version("torch")}
    package = policy_class.__module__.partition(".")[0]
    return software if package in software else software | package_software(package)


def package_software(package: str) -> dict[str, str]:
    """Version of a package that may be installed in place, with the digest of its sources."""
    return {package: f"{distribution_version(package)} ({_package_digest(package)})"}


@cache
def _package_digest(package: str) -> str:
    """Digest of a package's Python files: one that is installed in place changes without a new version."""
    spec = find_spec(package)
    places = list(spec.submodule_search_locations or []) if spec else []
    if not places:
        return digest_file(Path(spec.origin))[:SHORT] if spec and spec.origin else "unknown"
    return digest_files(_sources(Path(places[0]), ["."]))[:SHORT]
