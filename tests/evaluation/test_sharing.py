"""Evaluations in shards: the same results whoever plays which seeds, in any order, after kills, and on real clusters."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import psutil
import pytest

from hdril.cli.eval import EvalConfig, PolicySource, eval_command
from hdril.errors import UserError
from hdril.evaluation import evaluate
from hdril.evaluation.evaluate import make_job
from hdril.evaluation.journal import Journal
from hdril.execution import SlurmConfig
from hdril.files import BusyError
from tests.evaluation.checkpoints import experts_episode, listing, save_hdril, save_replay
from tests.evaluation.synthetic import outcome
from tests.fake_slurm import FakeSlurm, queued, real_partition, wait_until

SEED, COUNT = 930_000, 3


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory):
    """A cache of the expert's episodes that all tests of this module share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that plays what the expert did on the first seed."""
    return save_replay(tmp_path_factory.mktemp("policies") / "replay", experts_episode(SEED).action)


def play(policy: Path, output: Path, **options) -> None:
    given = {"num_episodes": COUNT, "seed": SEED, "workers": 1, "rerun": "none", "output_dir": output}
    eval_command(EvalConfig(PolicySource(str(policy)), **(given | options)))


@pytest.fixture(scope="module")
def alone(policy: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What one process writes, recordings of all episodes included."""
    output = tmp_path_factory.mktemp("alone") / "eval"
    play(policy, output, rerun="all")
    return reports(output)


def reports(output: Path) -> dict[str, bytes]:
    """The files of an evaluation that must be the same to the last byte; of recordings, which hold times, the names."""
    return {name: b"" if name.endswith(".rrd") else data for name, data in listing(output).items()}


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds that a policy played, in order."""
    seeds: list[int] = []
    play_one = evaluate.Worker.play

    def noting(self: evaluate.Worker, seed: int) -> evaluate.EvaluatedEpisode:
        seeds.append(seed)
        return play_one(self, seed)

    monkeypatch.setattr(evaluate.Worker, "play", noting)
    return seeds


def test_shards_of_any_number_and_order_make_the_same_report(
    policy: Path, alone: dict[str, bytes], tmp_path: Path, played: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "eval"
    for shard, shards, seeds in ((2, 3, [SEED + 2]), (0, 2, [SEED]), (1, 2, [SEED + 1]), (2, 3, [])):
        play(policy, output, rerun="all", shards=shards, shard=shard)
        assert played == seeds, (shard, shards)
        played.clear()
        assert not output.exists()
    assert "Shard 2 of 3 is played; the same command without --shard makes the report" in capsys.readouterr().out
    play(policy, output, rerun="all", shards=2)
    assert not played, "all was there"
    assert reports(output) == alone
    assert [path.name for path in tmp_path.iterdir()] == ["eval"]


def test_what_a_killed_shard_left_is_kept_and_the_rest_is_played(
    policy: Path, alone: dict[str, bytes], tmp_path: Path, played: list[int]
) -> None:
    output = tmp_path / "eval"
    play(policy, output, rerun="all", shards=1, shard=0)
    path = tmp_path / "eval.partial/shards/0-of-1/outcomes.jsonl"
    first, second, _ = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + second[:40])
    played.clear()
    play(policy, output, rerun="all", shards=1, shard=0)
    assert played == [SEED + 1, SEED + 2]
    assert path.read_bytes().splitlines(keepends=True)[:2] == [first, second]
    played.clear()
    play(policy, output, rerun="all")
    assert not played
    assert reports(output) == alone


def test_a_damaged_line_loses_its_own_episode_and_is_told_once(
    policy: Path, alone: dict[str, bytes], tmp_path: Path, played: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "eval"
    play(policy, output, rerun="all", shards=2, shard=1)
    path = tmp_path / "eval.partial/shards/1-of-2/outcomes.jsonl"
    first, last = path.read_bytes().splitlines(keepends=True)
    for damaged in (b"\xff" + first, first.replace(b"{", b"", 1), b'{"seed": 1}\n', b"3\n"):
        path.write_bytes(damaged + last)
        assert set(Journal(output, make_job("table_lift", str(policy), SEED, COUNT).identity).done) == {SEED + 2}
    played.clear()
    capsys.readouterr()
    play(policy, output, rerun="all")
    assert played == [SEED, SEED + 1]
    assert capsys.readouterr().err.count(f"{path}, line 1 is damaged: ") == 1
    assert reports(output) == alone


def test_a_damaged_record_is_told(policy: Path, tmp_path: Path) -> None:
    output = tmp_path / "eval"
    play(policy, output, shards=3, shard=0)
    (tmp_path / "eval.partial/run.json").write_text("{")
    before = listing(tmp_path)
    with pytest.raises(
        ValueError, match=r"run\.json is not valid JSON.*; what is in .*eval\.partial is not known: delete it"
    ):
        play(policy, output, shards=3, shard=0)
    assert listing(tmp_path) == before


def test_the_experts_cache_costs_time_and_nothing_else(
    policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    play(policy, tmp_path / "first")
    (folder,) = (tmp_path / "cache/hdril/expert").iterdir()
    kept = listing(folder)
    (folder / f"{SEED}.npz").write_bytes(b"power cut")
    (folder / f"{SEED + 1}.npz").write_bytes(kept[f"{SEED + 1}.npz"][:900])
    play(policy, tmp_path / "second")
    assert listing(folder) == kept, "made again"
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))  # no folder can be made in it
    play(policy, tmp_path / "third")
    assert reports(tmp_path / "first") == reports(tmp_path / "second") == reports(tmp_path / "third")


def test_a_suite_in_shards(policy: Path, tmp_path: Path, played: list[int]) -> None:
    options = {"suite": "factors", "cells": "push", "num_episodes": 2}
    play(policy, tmp_path / "alone", **options)
    assert len(played) == 6, "nominal, push and its control"
    played.clear()
    output = tmp_path / "suite"
    for shard in (1, 0):
        play(policy, output, **options, shards=2, shard=shard)
    assert sorted(played) == sorted([SEED, SEED + 1] * 3)
    played.clear()
    play(policy, output, **options)
    assert not played
    assert reports(output) == reports(tmp_path / "alone")


def test_shards_of_other_weights_are_refused(policy: Path, tmp_path: Path) -> None:
    output = tmp_path / "eval"
    play(policy, output, shards=3, shard=0)
    other = save_replay(tmp_path / "other", experts_episode(SEED).action[:60])
    before = listing(tmp_path)
    for options in ({"shard": 1}, {}):
        with pytest.raises(ValueError, match=r"eval\.partial holds results of other weights"):
            play(other, output, shards=3, **options)
    assert listing(tmp_path) == before


def test_a_shard_is_played_once_at_a_time_and_says_when_it_is_late(policy: Path, tmp_path: Path) -> None:
    journal = Journal(tmp_path / "eval", make_job("table_lift", str(policy), SEED, COUNT).identity)
    with journal.sharing(0, 2) as add:
        with pytest.raises(BusyError, match=r"another process is playing shard 0 of 2"), journal.sharing(0, 2):
            pass
        with journal.sharing(1, 2) as add_other:  # two shards at once
            add_other(outcome(SEED + 1))
            add(outcome(SEED))
        with journal.writing():
            assert set(journal.done) == {SEED, SEED + 1}
            journal.finish()
        with pytest.raises(
            UserError, match="was removed by another process, which finished the evaluation or gave it up"
        ):
            add(outcome(SEED + 2))
    assert [path.name for path in (tmp_path / "eval").iterdir()] == []


def test_shards_that_begin_at_the_same_moment_do_not_refuse_one_another(policy: Path, tmp_path: Path) -> None:
    """As those of an array do."""
    identity = make_job("table_lift", str(policy), SEED, COUNT).identity

    def begin(number: int, shard: int) -> None:
        with Journal(tmp_path / f"eval{number}", identity).sharing(shard, 8) as add:
            add(outcome(SEED + shard))

    with ThreadPoolExecutor(8) as pool:
        for number in range(20):
            list(pool.map(partial(begin, number), range(8)))
            assert set(Journal(tmp_path / f"eval{number}", identity).done) == set(range(SEED, SEED + 8))


def test_what_a_kill_left_of_the_record_keeps_nobody_out(policy: Path, tmp_path: Path) -> None:
    identity = make_job("table_lift", str(policy), SEED, COUNT).identity
    (tmp_path / "eval.partial").mkdir()
    (tmp_path / "eval.partial/.run.json.x.tmp").write_text('{"ident')
    journal = Journal(tmp_path / "eval", identity)
    with journal.writing() as add:
        add(outcome(SEED))
        journal.finish()
    assert not list((tmp_path / "eval").iterdir())


def test_a_command_that_is_stopped_leaves_the_shards_alone(policy: Path, tmp_path: Path) -> None:
    identity = make_job("table_lift", str(policy), SEED, COUNT).identity
    with Journal(tmp_path / "eval", identity).sharing(0, 2) as add:
        with pytest.raises(KeyboardInterrupt), Journal(tmp_path / "eval", identity).writing():
            raise KeyboardInterrupt
        add(outcome(SEED))
    assert set(Journal(tmp_path / "eval", identity).done) == {SEED}


def test_a_finish_that_is_killed_loses_nothing(policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    identity = make_job("table_lift", str(policy), SEED, COUNT).identity
    journal = Journal(tmp_path / "eval", identity)

    def killed(*_: object) -> None:
        raise SystemExit

    with journal.writing() as add:
        add(outcome(SEED))
        with monkeypatch.context() as patch:
            patch.setattr(Path, "replace", killed)
            with pytest.raises(SystemExit):
                journal.finish()
    assert set(Journal(tmp_path / "eval", identity).done) == {SEED}


def test_what_cannot_be_is_told_before_shards_are_asked_for(
    policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slurm = FakeSlurm(tmp_path / "slurm", monkeypatch)
    cluster = {"shards": 2, "executor": "slurm", "slurm": SlurmConfig("cpu")}
    with pytest.raises(FileNotFoundError, match="nowhere"):
        play(policy, tmp_path / "eval", against=tmp_path / "nowhere", **cluster)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        play(policy, tmp_path / "eval", against=tmp_path / "nowhere", suite="factors", cells="push", **cluster)
    (tmp_path / "eval.partial").mkdir()
    (tmp_path / "eval.partial/notes.txt").touch()
    for options in ({}, {"suite": "factors", "cells": "push"}):
        with pytest.raises(FileExistsError, match=r"eval\.partial exists and is no"):
            play(policy, tmp_path / "eval", **cluster, **options)
    assert not slurm.jobs
    with pytest.raises(ValueError, match="shards need --output_dir"):
        eval_command(EvalConfig(PolicySource(str(policy)), seed=SEED, shards=2, shard=0))


def test_options_that_do_nothing_together_are_refused(policy: Path, tmp_path: Path) -> None:
    for options, words in (
        ({"shards": 2, "shard": 2}, "shard must be from 0 to 1, got 2"),
        ({"shards": 2, "shard": 0, "push": "a/b"}, "--push comes when all is there"),
        ({"shards": 2, "shard": 0, "executor": "ray"}, "--shard plays here"),
        ({"executor": "lsf"}, "executor must be local, slurm, ray"),
    ):
        with pytest.raises((ValueError, UserError), match=words):
            play(policy, tmp_path / "eval", **options)
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- clusters


@pytest.fixture(scope="module")
def untrained(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """HDR-IL that other processes can load."""
    return save_hdril(tmp_path_factory.mktemp("untrained") / "policy", dataset)


def test_slurm_is_asked_for_shards_and_for_a_last_job_that_reports(
    untrained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    slurm, output = FakeSlurm(tmp_path / "slurm", monkeypatch), tmp_path / "eval"
    play(untrained, tmp_path / "alone", num_episodes=2)
    play(untrained, output, num_episodes=2, shards=2, executor="slurm", slurm=SlurmConfig("cpu"))
    assert "Submitted 2 shards as job 100" in capsys.readouterr().out
    shards, finish = (job for job in slurm.jobs if "launch_pickled_pipeline" in job.script)
    assert not output.exists()
    shards.run(only=1)
    finish.run()
    assert reports(output) == reports(tmp_path / "alone")


Command = Callable[..., list[str]]
"""The command of an evaluation, with more options, for the working folder that the result is to be in."""


ONE, SUITE = ("--num_episodes=6",), ("--num_episodes=2", "--suite=factors", "--cells=push")


@pytest.fixture(scope="module", params=[ONE, SUITE], ids=["one", "suite"])
def command(request: pytest.FixtureRequest, untrained: Path) -> Command:
    """Asks for the folder ``eval``."""
    program = Path(sys.executable).with_name("hdril-eval")
    line = [str(program), f"--policy.path={untrained}", f"--seed={SEED}", "--output_dir=eval", "--rerun=none"]
    return lambda *options: [*line, *request.param, *options]


@pytest.fixture(scope="module")
def whole(command: Command, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What the command writes in one process."""
    folder = tmp_path_factory.mktemp("whole")
    said(command("--workers=1"), folder)
    return reports(folder / "eval")


only_one = pytest.mark.parametrize("command", [ONE], ids=["one"], indirect=True, scope="module")


def said(line: list[str], folder: Path) -> str:
    """What a command prints that runs in ``folder`` and must succeed."""
    return subprocess.run(line, check=True, capture_output=True, text=True, cwd=folder).stdout


def count_played(folder: Path, share: str) -> int:
    """Episodes of a share of the evaluation ``eval`` that are kept."""
    path = folder / "eval.partial/shards" / share / "outcomes.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def check_whole(folder: Path, whole: dict[str, bytes]) -> None:
    """The results are those of one process, and nothing but logs is beside them."""
    assert reports(folder / "eval") == whole
    assert sorted(path.name for path in folder.iterdir()) == ["eval", "eval.jobs"]


@pytest.mark.long
def test_ray_gives_the_same_results(command: Command, whole: dict[str, bytes], tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is an extra")
    said(command("--executor=ray", "--shards=2", "--workers=2"), tmp_path)
    check_whole(tmp_path, whole)


@pytest.mark.long
def test_slurm_gives_the_same_results(command: Command, whole: dict[str, bytes], tmp_path: Path) -> None:
    line = command("--executor=slurm", "--shards=2", "--workers=2", f"--slurm.partition={real_partition()}")
    assert "Submitted 2 shards as job " in said(line, tmp_path)
    wait_until((tmp_path / "eval").exists)
    wait_until(lambda: not queued(tmp_path))
    check_whole(tmp_path, whole)


@pytest.mark.long
@only_one
def test_ray_says_that_a_shard_was_killed_and_goes_on(
    command: Command, whole: dict[str, bytes], tmp_path: Path
) -> None:
    pytest.importorskip("ray", reason="Ray is an extra")
    line = command("--executor=ray", "--shards=2", "--workers=2")
    with subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        wait_until(lambda: count_played(tmp_path, "0-of-2"))
        lock = str(tmp_path / "eval.partial/shards/0-of-2/lock")
        for player in psutil.Process(process.pid).children(recursive=True):
            if lock in (file.path for file in player.open_files()):
                player.kill()
        _, told = process.communicate(timeout=300)
    assert process.returncode == 2
    assert told.endswith("error: 1 of 2 shards failed, the first is 0; their logs: eval.jobs/logs\n")
    assert 0 < count_played(tmp_path, "0-of-2") < 3
    assert count_played(tmp_path, "1-of-2") == 3
    said(line, tmp_path)
    check_whole(tmp_path, whole)


@pytest.mark.long
@only_one
def test_slurm_goes_on_where_jobs_were_cancelled_and_makes_good_what_was_killed(
    command: Command, whole: dict[str, bytes], tmp_path: Path
) -> None:
    line = command("--executor=slurm", "--shards=2", "--workers=1", f"--slurm.partition={real_partition()}")
    said(line, tmp_path)
    wait_until(lambda: count_played(tmp_path, "0-of-2"))
    subprocess.run(["scancel", *{job.partition("_")[0] for job in queued(tmp_path)}], check=True)
    wait_until(lambda: not queued(tmp_path))
    kept = count_played(tmp_path, "0-of-2")
    assert 0 < kept < 3
    assert not (tmp_path / "eval").exists()
    (array,) = re.findall(r"Submitted 2 shards as job (\d+);", said(line, tmp_path))
    wait_until(lambda: count_played(tmp_path, "1-of-2"))
    subprocess.run(["scancel", "--signal=KILL", f"{array}_1"], check=True)
    wait_until((tmp_path / "eval").exists)
    wait_until(lambda: not queued(tmp_path))  # what depends on the array's success, too
    assert listing(tmp_path / "eval.jobs/shards/completions") == {"00000": b""}, "the second shard was killed"
    check_whole(tmp_path, whole)
