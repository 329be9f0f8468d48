"""Who knows whom: which rooms of the house may import which, read from the source."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hdril

PACKAGE = Path(hdril.__file__).parent
POLICY = PACKAGE.parent / "policies" / "lerobot_policy_hdril" / "src" / "lerobot_policy_hdril"

BOTTOM = {"digest", "errors", "execution", "files", "geometry", "markdown", "plugins", "workers"}
"""Modules that know nothing of robots and tasks. Every room may import them, and they import only one another."""

BELOW: dict[str, set[str]] = {name: set() for name in BOTTOM} | {
    "actor": set(),
    "simulation": set(),
    "tasks": {"simulation", "actor"},
    "env": {"tasks"},
    "rollout": {"env"},
    "trace": {"rollout"},
    "demonstrations": {"trace"},
    "evaluation": {"trace", "demonstrations"},
    "viewer": {"evaluation"},
    "hub": {"evaluation"},
    "benchmark": {"evaluation"},
    "lerobot_env": {"viewer"},
    "cli": {"viewer", "hub", "benchmark", "lerobot_env"},
    "aloha": {"cli"},
}
"""What each room may import, with everything below that. ``hdril/__init__.py`` may import tasks, to register them."""

OF_THE_POLICY = {
    "hub": {"lerobot_policy_hdril.card.CITATION", "lerobot_policy_hdril.card.EVALUATION"},
    "cli": {"lerobot_policy_hdril.HDRILConfig"},  # hdril-bench times the training of the policy
}
"""What each room may import of the policy. Everything else is known through LeRobot's interface and ``explain()``."""


def imports(file: Path) -> Iterator[str]:
    """Dotted names of what a file imports, wherever in the file it does."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def allowed(room: str) -> set[str]:
    """The room itself, and everything below it."""
    return BOTTOM.union({room}, *(allowed(other) for other in BELOW[room]))


def sources() -> list[tuple[str, Path]]:
    """Room and file of every module of hdril."""
    files = sorted(file for file in PACKAGE.rglob("*.py") if file != PACKAGE / "__init__.py")
    return [(file.relative_to(PACKAGE).parts[0].removesuffix(".py"), file) for file in files]


SOURCES = pytest.mark.parametrize(
    ("room", "file"), sources(), ids=[str(file.relative_to(PACKAGE)) for _, file in sources()]
)


def test_every_room_has_its_place() -> None:
    assert {room for room, _ in sources()} == set(BELOW)


@SOURCES
def test_a_module_imports_only_what_is_below_it(room: str, file: Path) -> None:
    known = {name.split(".")[1] for name in imports(file) if name.startswith("hdril.")} - {"__version__"}
    assert known <= allowed(room), f"{room} may not import {', '.join(sorted(known - allowed(room)))}"


@SOURCES
def test_only_the_world_imports_pybullet(room: str, file: Path) -> None:
    uses = {name for name in imports(file) if name.split(".")[0] in ("pybullet", "pybullet_data", "pybullet_utils")}
    assert not uses or file == PACKAGE / "simulation" / "world.py"


@SOURCES
def test_processes_are_started_in_one_place(room: str, file: Path) -> None:
    """Pools of their own would leave their workers behind when a command is killed."""
    pools = {name for name in imports(file) if name.split(".")[0] == "multiprocessing" or "ProcessPool" in name}
    assert not pools or room == "workers"


def test_the_package_itself_imports_tasks_alone() -> None:
    known = {name.split(".")[1] for name in imports(PACKAGE / "__init__.py") if name.startswith("hdril.")}
    assert known == {"tasks"}


@pytest.mark.parametrize("file", sorted(POLICY.glob("*.py")), ids=lambda file: file.name)
def test_the_policy_imports_nothing_of_hdril_or_pybullet(file: Path) -> None:
    assert not {name for name in imports(file) if name.split(".")[0] in ("hdril", "pybullet")}


@SOURCES
def test_hdril_knows_little_of_the_policy(room: str, file: Path) -> None:
    used = {name for name in imports(file) if name.startswith("lerobot_policy_hdril")}
    assert used <= OF_THE_POLICY.get(room, set())


SLOW = ("torch", "lerobot", "pandas", "statsmodels", "matplotlib", "rerun", "datatrove")
"""Libraries that take long to import: a command waits for those that it needs, and says what is wrong before that."""


@pytest.mark.parametrize("command", ["record", "check", "labels", "eval", "benchmark", "bench"])
def test_a_command_starts_without_what_it_may_not_need(command: str) -> None:
    program = f"import sys, hdril.cli.{command}; print(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert not set(SLOW) & set(loaded)
