"""What a user can mend is one line; what only a programmer can mend keeps its traceback."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.commands import call, succeed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["hdril-record", "--repo_id=a/b", "--task=chess"], "unknown task 'chess'; choose from: "),
        (["hdril-record", "--repo-id=a/b", "--num-episodes=0"], "num_episodes must be at least 1, got 0"),
        (["hdril-record", "--repo_id=nameless"], "repo_id must look like user/name, got 'nameless'"),
        (["hdril-record", "--repo_id=nameless", "--push"], "repo_id must look like user/name, got 'nameless'"),
        (["hdril-eval", "--policy.path=x/y", "--push=nameless"], "push must look like user/name, got 'nameless'"),
        (["hdril-record", "--repo_id=a/b", "--noise.waypoint=1"], "noise.waypoint must be from 0 to 0.02 m"),
        (["hdril-record", "--repo_id=a/b", "--colour=red"], "--colour"),
        (["hdril-eval", "--policy.path=no/such/place"], "no checkpoint at no/such/place"),
        (["hdril-eval", "--policy.path=x/y", "--task=chess"], "unknown task 'chess'; choose from: "),
        (["hdril-eval", "--policy.path=x/y", "--num_episodes=0"], "num_episodes must be at least 1, got 0"),
        (["hdril-eval", "--policy.path=x/y", "--rerun=some"], "rerun must be failures, all, none or a number"),
    ],
)
def test_refusals_are_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    where = [f"--root={tmp_path / 'out'}"] if arguments[0] == "hdril-record" else [f"--output_dir={tmp_path / 'out'}"]
    done = call(*arguments, *where)
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"{arguments[0]}: error: ")
    assert message in last
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "option"),
    [("hdril-record", "--task"), ("hdril-eval", "--task"), ("hdril-bench", "--task"), ("hdril-view", "--against")],
)
def test_help(command: str, option: str) -> None:
    text = succeed(command, "--help")
    assert option in text
    assert "Traceback" not in text
