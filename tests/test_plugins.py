"""Tasks and robots of other packages: a real one, installed; and what is wrong with others, said by name."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

import hdril.tasks
from hdril.plugins import PluginError, Registry
from hdril.simulation.robots import _read as read_robot
from hdril.simulation.robots.baxter import BAXTER
from hdril.tasks import TASKS, _discover
from hdril.tasks import _read as read_task

TASK_SOURCE = dedent(
    """
    from dataclasses import replace

    from hdril.tasks.bench import BENCH
    from hdril.tasks.conditions import at_height, raised
    from hdril.tasks.primitives import grasp, lift
    from hdril.tasks.table_lift import GRIPS, TASK as TABLE_LIFT


    def make_task(height=0.1):
        return replace(
            TABLE_LIFT,
            name="raise_table",
            description="Raise the table.",
            primitives=(grasp(GRIPS), lift("table", height)),
            success=(raised("table", height - 0.03),),
        )


    TASK = make_task()
    """
)
PYPROJECT = dedent(
    """
    [build-system]
    requires = ["hatchling"]
    build-backend = "hatchling.build"

    [project]
    name = "tables-galore"
    version = "2.1"

    [project.entry-points."hdril.tasks"]
    raise_table = "tables_galore.raise_table"

    [project.entry-points."hdril.robots"]
    second_baxter = "tables_galore.robots:ROBOT"

    [tool.hatch.build.targets.wheel]
    packages = ["tables_galore"]
    """
)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed a package that adds a task and a robot."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    (source / "tables_galore").mkdir()
    (source / "pyproject.toml").write_text(PYPROJECT)
    (source / "tables_galore" / "__init__.py").write_text("")
    (source / "tables_galore" / "raise_table.py").write_text(TASK_SOURCE)
    (source / "tables_galore" / "robots.py").write_text(
        "from dataclasses import replace\nfrom hdril.simulation.robots.baxter import BAXTER\n"
        "ROBOT = replace(BAXTER, name='second_baxter')\n"
    )
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--target", str(target), str(source)], check=True)
    return target


def run(code: str, path: Path) -> subprocess.CompletedProcess[str]:
    """Python code in a process of its own, with a folder of installed packages."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(path), os.environ.get("PYTHONPATH", "")])}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)


def test_an_installed_task_is_recorded_like_any_other(installed: Path, tmp_path: Path) -> None:
    program = f"""
import json
from pathlib import Path
import hdril, gymnasium
from hdril.demonstrations.provenance import Recipe, read_provenance
from hdril.demonstrations.record import record
from hdril.env import BimanualEnv
from hdril.simulation.robots import ROBOTS
from hdril.tasks import TASKS, get_task, task_parameters

root = Path({str(tmp_path / "data")!r})
recording = record(Recipe("raise_table"), 1, 0, root)
try:
    get_task("chess")
except ValueError as error:
    unknown = str(error)
print(json.dumps(dict(
    tasks=list(TASKS), robots=list(ROBOTS), unknown=unknown, seeds=recording.seeds,
    recorded=read_provenance(root).recipe.task, horizon=get_task("raise_table").horizon,
    higher=task_parameters("raise_table:height=0.2"), robot=BimanualEnv(robot="second_baxter").robot_spec.name,
    made=gymnasium.make("hdril/RaiseTable-v0", disable_env_checker=True).unwrapped.task)))
"""
    result = run(program, installed)
    assert result.returncode == 0, result.stderr
    said = json.loads(result.stdout.splitlines()[-1])
    assert said["tasks"] == [*TASKS, "raise_table"]
    assert said["robots"] == ["baxter", "second_baxter"]
    assert said["unknown"] == f"unknown task 'chess'; choose from: {', '.join([*TASKS, 'raise_table'])}"
    assert (said["recorded"], said["made"], said["robot"]) == ("raise_table", "raise_table", "second_baxter")
    assert said["higher"]["height"] == 0.2
    assert len(said["seeds"]) == 1
    assert said["horizon"] == 22
    assert (tmp_path / "data" / "meta" / "info.json").exists()


# ---------------------------------------------------------------------- what is wrong with a plugin


def declare(folder: Path, distribution: str, group: str, **entries: str) -> None:
    """What an installer leaves of a distribution: its name, its version and its entry points."""
    info = folder / f"{distribution}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
    lines = [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


def tasks_with(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Registry:
    monkeypatch.syspath_prepend(folder)
    return Registry("task", "hdril.tasks", _discover(), read_task)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        (
            "import not_installed_anywhere",
            "cannot be loaded: ModuleNotFoundError: No module named 'not_installed_anywhere'",
        ),
        ("1 / 0", "cannot be loaded: ZeroDivisionError: division by zero"),
        ("raise SystemExit('no\\nlicence')", "cannot be loaded: SystemExit: no licence"),
        ("raise TypeError('a bug')", "cannot be loaded: TypeError: a bug"),
        ("", "cannot be used: broken_plugin defines no TASK of type hdril.tasks.Task"),
        ("TASK = 'chess'", "cannot be used: broken_plugin defines no TASK of type hdril.tasks.Task"),
        ("def __getattr__(name): 1 / 0", "cannot be used: ZeroDivisionError: division by zero"),
    ],
)
def test_a_task_that_cannot_be_loaded_says_why(monkeypatch, tmp_path: Path, source: str, reason: str) -> None:
    """The distribution, the entry point and the reason; and nobody else is stopped."""
    (tmp_path / "broken_plugin.py").write_text(source)
    declare(tmp_path, "chess-club", "hdril.tasks", chess="broken_plugin")
    tasks = tasks_with(monkeypatch, tmp_path)
    monkeypatch.delitem(sys.modules, "broken_plugin", raising=False)
    assert list(tasks) == [*TASKS, "chess"]
    assert len(tasks) == len(TASKS) + 1
    assert tasks.find("table_lift") is TASKS["table_lift"]
    for ask in (tasks.find, tasks.source):
        with pytest.raises(PluginError) as caught:
            ask("chess")
        origin = "chess-club 1.0 (entry point hdril.tasks: chess = broken_plugin)"
        assert str(caught.value) == f"the task 'chess' from {origin} {reason}"


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        ("task", "hdril.tasks.table_lift:TASK", "defines no TASK of type hdril.tasks.Task"),
        ("task", "hdril.tasks.task:Task", "defines no TASK of type hdril.tasks.Task"),
        ("task", "of_two_lines:THING", "defines no TASK of type hdril.tasks.Task"),
        ("robot", "hdril.tasks.table_lift:TASK", "is not a hdril.simulation.robots.RobotSpec"),
        ("robot", "hdril.simulation.robots:RobotSpec", "is not a hdril.simulation.robots.RobotSpec"),
        ("robot", "hdril.simulation.robots.baxter", "is not a hdril.simulation.robots.RobotSpec"),
        ("robot", "of_two_lines:THING", "is not a hdril.simulation.robots.RobotSpec"),
    ],
)
def test_what_is_no_entry_is_refused_in_one_line(
    monkeypatch, tmp_path: Path, kind: str, value: str, expected: str
) -> None:
    """A task instead of its module, a class instead of a robot, or an object whose ``repr`` fills a page."""
    (tmp_path / "of_two_lines.py").write_text(
        "class Thing:\n    def __repr__(self): return 'one\\ntwo' * 999\nTHING = Thing()\n"
    )
    declare(tmp_path, "chess-club", f"hdril.{kind}s", chess=value)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "of_two_lines", raising=False)
    read: Callable[[Any], Any] = read_task if kind == "task" else read_robot
    with pytest.raises(PluginError) as caught:
        Registry(kind, f"hdril.{kind}s", {}, read).find("chess")
    message = str(caught.value)
    assert message.startswith(
        f"the {kind} 'chess' from chess-club 1.0 (entry point hdril.{kind}s: chess = {value}) cannot be used: "
    )
    assert message.endswith(expected)
    assert "\n" not in message
    assert len(message) < 400


def test_a_task_of_another_name_than_its_entry_point_is_refused(monkeypatch, tmp_path: Path) -> None:
    declare(tmp_path, "chess-club", "hdril.tasks", chess="hdril.tasks.table_lift")
    with pytest.raises(PluginError, match=r"chess-club 1\.0 .* is named 'table_lift'; .* not 'chess'$"):
        tasks_with(monkeypatch, tmp_path).find("chess")


def test_two_tasks_of_one_name_are_refused(monkeypatch, tmp_path: Path) -> None:
    declare(tmp_path, "impostor", "hdril.tasks", table_lift="hdril.tasks.table_lift")
    declare(tmp_path, "first", "hdril.tasks", chess="a")
    declare(tmp_path, "second", "hdril.tasks", chess="b")
    tasks = tasks_with(monkeypatch, tmp_path)
    assert list(tasks) == [*TASKS, "chess"]
    with pytest.raises(
        PluginError, match=r"^two tasks are named 'table_lift': one is from hdril itself, another from impostor 1"
    ):
        tasks.find("table_lift")
    with pytest.raises(PluginError, match=r"^two tasks are named 'chess': .*first 1\.0.*, another from second 1\.0"):
        tasks.find("chess")
    assert tasks.find("peg_in_hole").name == "peg_in_hole"


def test_a_plugin_is_imported_when_it_is_asked_for_and_once(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "counted_plugin.py").write_text(TASK_SOURCE + f"\nopen({str(tmp_path / 'log')!r}, 'a').write('x')\n")
    declare(tmp_path, "tables", "hdril.tasks", raise_table="counted_plugin")
    tasks, log = tasks_with(monkeypatch, tmp_path), tmp_path / "log"
    assert "raise_table" in tasks
    assert not log.exists()
    assert tasks["raise_table"] is tasks.find("raise_table") is tasks.source("raise_table").TASK
    assert log.read_text() == "x"
    del sys.modules["counted_plugin"]


def test_a_robot_must_be_one(monkeypatch, tmp_path: Path) -> None:
    declare(tmp_path, "arms", "hdril.robots", octopus="math:pi")
    monkeypatch.syspath_prepend(tmp_path)
    robots = Registry("robot", "hdril.robots", {"baxter": BAXTER}, read_robot)
    with pytest.raises(PluginError, match=r"the robot 'octopus' from arms 1\.0 .*: 3\.14\d* is not a .*RobotSpec$"):
        robots.find("octopus")
    with pytest.raises(ValueError, match=r"^unknown robot 'hal'; choose from: baxter, octopus$"):
        robots.find("hal")
    with pytest.raises(KeyError, match="no robot 'hal'; robots: baxter, octopus"):
        robots["hal"]


def test_a_missing_import_in_a_task_of_our_own_is_raised(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "half_done.py").write_text("import not_installed_anywhere\n")
    monkeypatch.setattr(hdril.tasks, "__path__", [*hdril.tasks.__path__, str(tmp_path)])
    with pytest.raises(ModuleNotFoundError, match="not_installed_anywhere"):
        _discover()


def test_two_of_our_own_modules_may_not_define_one_task(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "zzz_again.py").write_text("from hdril.tasks.table_lift import TASK\n")
    monkeypatch.setattr(hdril.tasks, "__path__", [*hdril.tasks.__path__, str(tmp_path)])
    with pytest.raises(
        ValueError, match=r"^two tasks are named 'table_lift': hdril\.tasks\.table_lift and hdril\.tasks\.zzz_again$"
    ):
        _discover()
    del sys.modules["hdril.tasks.zzz_again"]
