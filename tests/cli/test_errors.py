"""What a user can mend is one line; what only a programmer can mend keeps its traceback."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import draccus
import pytest

from hdril import __version__
from hdril.cli.common import check_repo_id, run
from hdril.demonstrations.provenance import RECIPE_PATH, Provenance, Recipe
from hdril.demonstrations.record import ExpertError
from hdril.demonstrations.write import write_dataset
from hdril.errors import UserError
from hdril.files import BusyError
from hdril.hub.publish import HubError
from tests.cli.commands import refuse, succeed


@dataclass
class Options:
    """Options of a command that only fails."""

    number: int = 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["hdril-record", "--task=chess"], "unknown task 'chess'; choose from: "),
        (["hdril-record", "--num-episodes=0"], "num_episodes must be at least 1, got 0"),
        (["hdril-record", "--repo_id=nameless"], "repo_id must look like user/name, got 'nameless'"),
        (["hdril-record", "--repo_id=a b/c"], "repo_id must look like user/name, got 'a b/c': Repo id must use"),
        (["hdril-record", "--push"], "--push needs --repo_id"),
        (["hdril-record", "--noise.waypoint=1"], "noise.waypoint must be from 0 to 0.02 m"),
        (["hdril-record", "--colour=red"], "--colour"),
        (["hdril-record", "--num_episodes=many"], "`num_episodes`: Couldn't parse 'many' into an int"),
        (["hdril-eval", "--policy.path=x/y", "--push=nameless"], "push must look like user/name, got 'nameless'"),
        (["hdril-eval", "--policy.path=no/such/place"], "no checkpoint at no/such/place"),
        (["hdril-eval", "--policy.path=x/y", "--task=chess"], "unknown task 'chess'; choose from: "),
        (["hdril-eval", "--policy.path=x/y", "--num_episodes=0"], "num_episodes must be at least 1, got 0"),
        (["hdril-eval", "--policy.path=x/y", "--rerun=some"], "rerun must be failures, all, none or a number"),
        (["hdril-bench", "--task=chess"], "unknown task 'chess'; choose from: "),
        (["hdril-check", "no/such/place"], "no/such/place is no LeRobot dataset: it has no meta/info.json"),
        (["hdril-record", "--labels=language"], "labels must have subtask_index; it may have language beside it"),
        (["hdril-record", "--labels=subtask_index,sign"], "labels must be of subtask_index, language, got 'sign'"),
        (["hdril-record", "--executor=slurm"], "--executor=slurm needs --slurm.partition"),
        (["hdril-record", "--shard=2", "--shards=2"], "shard must be from 0 to 1, got 2"),
        (["hdril-labels", "no/such/place", "--to=language", "--output=x"], "no/such/place is no LeRobot dataset"),
        (["hdril-labels", "x", "--to=subtask_index,language", "--output=y"], "to must be one form"),
        (["hdril-check", "x", "--remake=some"], "remake must be a number of episodes or all, got 'some'"),
        (["hdril-check"], "`dataset`"),
        (["hdril-view"], "give either --run (an evaluation) or --dataset"),
    ],
)
def test_refusals_are_one_line(arguments: list[str], message: str, tmp_path: Path, monkeypatch, capsys) -> None:
    where = {"hdril-record": [f"--root={tmp_path / 'out'}"], "hdril-eval": [f"--output_dir={tmp_path / 'out'}"]}
    command = arguments[0]
    monkeypatch.setattr(sys, "argv", [*arguments, *where.get(command, [])])
    with pytest.raises(SystemExit) as caught:
        import_module(f"hdril.cli.{command.removeprefix('hdril-')}").main()
    assert caught.value.code == 2
    text = capsys.readouterr().err
    last = text.strip().splitlines()[-1]
    assert last.startswith(f"{command}: error: ")
    assert message in last
    assert "Traceback" not in text
    assert not list(tmp_path.iterdir())


def test_the_installed_command_refuses_in_one_line(tmp_path: Path) -> None:
    assert refuse("hdril-record", "--task=chess", f"--root={tmp_path / 'x'}").startswith("unknown task 'chess'")


def fail(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that fails with this error."""

    def command(options: Options) -> None:
        raise error

    monkeypatch.setattr(sys, "argv", ["hdril-fail"])
    run("hdril-fail", Options, command)


EXPECTED = [
    UserError("no"),
    ExpertError("no"),
    HubError("no"),
    BusyError("no"),
    ValueError("no"),
    FileExistsError("no"),
    FileNotFoundError("no"),
    PermissionError("no"),
]
BUGS = [
    KeyError("no"),
    RuntimeError("no"),
    IndexError("no"),
    TypeError("no"),
    AssertionError("no"),
    StopIteration("no"),
]


@pytest.mark.parametrize("error", EXPECTED, ids=lambda error: type(error).__name__)
def test_what_a_user_can_mend_is_one_line(error: Exception, monkeypatch, capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        fail(error, monkeypatch)
    assert caught.value.code == 2
    assert capsys.readouterr().err == "hdril-fail: error: no\n"
    monkeypatch.setenv("HDRIL_DEBUG", "1")
    with pytest.raises(type(error)):
        fail(error, monkeypatch)


def test_a_message_of_several_lines_becomes_one(monkeypatch, capsys) -> None:
    with pytest.raises(SystemExit):
        fail(ValueError("first\n  second"), monkeypatch)
    assert capsys.readouterr().err == "hdril-fail: error: first second\n"


@pytest.mark.parametrize("error", BUGS, ids=lambda error: type(error).__name__)
def test_a_bug_is_not_taken_for_a_users_error(error: Exception, monkeypatch, capsys) -> None:
    with pytest.raises(type(error)):
        fail(error, monkeypatch)
    assert "error: no" not in capsys.readouterr().err


@dataclass
class Faulty:
    """Options whose check has a bug."""

    def __post_init__(self) -> None:
        raise TypeError("not a number")


def test_a_bug_in_the_check_of_options_keeps_its_traceback(monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["hdril-fail"])
    with pytest.raises(draccus.utils.DraccusException) as caught:
        run("hdril-fail", Faulty, lambda _: None)
    assert isinstance(caught.value.__cause__, TypeError)


def test_a_bug_gives_its_traceback_and_exit_code_1(tmp_path: Path) -> None:
    """The world is asked for a body that it does not have, as if the task had named a wrong one."""
    code = (
        "import hdril.cli.record as command\n"
        "from hdril.simulation.world import World\n"
        "command.record = lambda *_: World().pose('chair')\n"
        "command.main()\n"
    )
    arguments = [sys.executable, "-c", code, f"--root={tmp_path / 'x'}"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "no body 'chair'" in done.stderr.splitlines()[-1]


def test_ctrl_c_is_130(monkeypatch, capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        fail(KeyboardInterrupt(), monkeypatch)
    assert caught.value.code == 130
    assert capsys.readouterr().err == "\nhdril-fail: interrupted\n"


@pytest.mark.parametrize(
    "name", ["", "nameless", "a/b/c", "a b/c", "a/b..c", "a--b/c", "-a/b", "a/b.git", "a/" + 97 * "b"]
)
def test_names_that_the_hub_would_not_take_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="push must look like user/name, got ") as caught:
        check_repo_id("push", name)
    assert repr(name) in str(caught.value)


@pytest.mark.parametrize("name", ["user/name", "User-1/table_lift.v2"])
def test_names_that_the_hub_takes_pass(name: str) -> None:
    check_repo_id("push", name)


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("hdril-record", "--task"),
        ("hdril-eval", "--task"),
        ("hdril-check", "--remake"),
        ("hdril-labels", "--to"),
        ("hdril-bench", "--task"),
        ("hdril-view", "--against"),
    ],
)
def test_help(command: str, option: str) -> None:
    text = succeed(command, "--help")
    assert option in text
    assert "Traceback" not in text


def test_provenance_that_cannot_be_read_is_one_line(made_up, tmp_path: Path) -> None:
    root = tmp_path / "set"
    write_dataset(root, Provenance(Recipe("table_lift"), (0,)), [made_up(0)])
    path = root / RECIPE_PATH
    path.write_text(json.dumps({key: value for key, value in json.loads(path.read_text()).items() if key != "dropped"}))
    expected = f"hdril {__version__} cannot read {path}: it has no field dropped"
    options = [f"--root={root}", "--repo_id=user/name", "--num_episodes=1", "--push=true"]
    assert refuse("hdril-record", *options) == expected
    assert refuse("hdril-view", f"--dataset={root}", f"--save={tmp_path / 'x.rrd'}") == expected
    assert list(tmp_path.iterdir()) == [root]
