"""Work in shards: shares of seeds, and the clusters that play them."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hdril.cli.record import RecordConfig, record_command
from hdril.demonstrations.episode import Episode, demonstrate
from hdril.demonstrations.provenance import Provenance, Recipe, read_provenance
from hdril.demonstrations.record import partial_folder, record, record_shard
from hdril.demonstrations.shards import Shards
from hdril.errors import UserError
from hdril.execution import SlurmConfig, Work, check_execution, run_on_ray, share
from tests.fake_slurm import FakeSlurm, real_partition, wait_until

COUNT = 5
RECIPE = Recipe("table_lift")


@pytest.mark.parametrize("shards", [1, 2, 3, 7, 10, 13])
def test_shares_are_the_whole_in_order_and_alike(shards: int) -> None:
    seeds = range(100, 110)
    shares = [share(seeds, shard, shards) for shard in range(shards)]
    assert [seed for each in shares for seed in each] == list(seeds)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@pytest.mark.parametrize("shard", [-1, 3])
def test_a_share_that_there_is_not(shard: int) -> None:
    with pytest.raises(ValueError, match=f"shard must be from 0 to 2, got {shard}"):
        share(range(10), shard, 3)


def test_what_is_missing_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_execution("local", 1, SlurmConfig())
    with pytest.raises(ValueError, match="executor must be local, slurm, ray, got 'lsf'"):
        check_execution("lsf", 1, SlurmConfig())
    with pytest.raises(ValueError, match="shards must be at least 1, got 0"):
        check_execution("local", 0, SlurmConfig())
    with pytest.raises(ValueError, match=r"--executor=slurm needs --slurm\.partition"):
        check_execution("slurm", 2, SlurmConfig())
    with monkeypatch.context() as patch:
        slurm = FakeSlurm(tmp_path, patch)
        patch.setattr("sys.prefix", str(tmp_path / "conda"))
        config = RecordConfig(num_episodes=1, root=tmp_path / "set", executor="slurm", slurm=SlurmConfig("cpu"))
        with pytest.raises(UserError, match=r"needs .*conda/bin/activate, which its jobs source: start hdril from"):
            record_command(config)
        assert not slurm.jobs
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match="--executor=slurm needs Slurm's sbatch, which is not on the PATH"):
        check_execution("slurm", 2, SlurmConfig(partition="all"))
    monkeypatch.setattr("hdril.execution.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"--executor=ray needs Ray, the extra ray of hdril"):
        check_execution("ray", 2, SlurmConfig())


# --------------------------------------------------------------------- recording


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Provenance:
    """What one process records."""
    return record(RECIPE, COUNT, 50, tmp_path_factory.mktemp("alone") / "set")


def test_shards_in_any_order_and_number_make_the_same_dataset(alone: Provenance, tmp_path: Path, monkeypatch) -> None:
    root = tmp_path / "set"
    record_shard(RECIPE, COUNT, 50, root, 2, 3)
    record_shard(RECIPE, COUNT, 50, root, 0, 2)
    kept = sorted(path.name for path in partial_folder(root).glob("*.npz"))
    assert kept == ["50.npz", "51.npz", "53.npz", "54.npz"]
    played: list[int] = []
    record_shard(RECIPE, COUNT, 50, root, 1, 3, progress=lambda kept, dropped: played.append(kept))
    assert played == [1], "51 was there already"
    monkeypatch.setattr("hdril.demonstrations.record.demonstrate", None)  # nothing is left to be played
    made = record(RECIPE, COUNT, 50, root)
    assert made == alone == read_provenance(root)
    assert made.digest
    assert not partial_folder(root).exists()


def test_what_shards_left_is_played_and_nothing_else(alone: Provenance, tmp_path: Path, monkeypatch) -> None:
    root = tmp_path / "set"
    record_shard(RECIPE, COUNT, 50, root, 1, 2)
    (partial_folder(root) / "53.npz").write_bytes(b"half")
    played: list[int] = []

    def note(env, expert, seed: int):
        played.append(seed)
        return demonstrate(env, expert, seed)

    monkeypatch.setattr("hdril.demonstrations.record.demonstrate", note)
    assert record(RECIPE, COUNT, 50, root) == alone
    assert played == [50, 51, 53]


def test_a_shard_refuses_what_the_whole_refuses(alone: Provenance, tmp_path: Path) -> None:
    root = tmp_path / "set"
    record_shard(RECIPE, COUNT, 50, root, 4, 5)
    with pytest.raises(ValueError, match="holds episodes of another recipe"):
        record_shard(Recipe("table_lift", perturb=0.001), COUNT, 50, root, 4, 5)
    with pytest.raises(ValueError, match="num_episodes must be at least 1"):
        record_shard(RECIPE, 0, 50, tmp_path / "other", 0, 1)
    root.mkdir()
    with pytest.raises(FileExistsError, match="choose another root or delete it"):
        record_shard(RECIPE, COUNT, 50, root, 0, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set", "set.partial"]


def test_a_shard_that_is_late_says_so(made_up, tmp_path: Path) -> None:
    """The recording was finished meanwhile; nothing is left behind that a later one could take for its own."""
    shards = Shards(tmp_path / "set.partial", RECIPE, 50)
    shards.put(made_up(50))
    shutil.rmtree(tmp_path / "set.partial")
    with pytest.raises(UserError, match="was removed by another process, which finished the recording or gave it up"):
        shards.put(made_up(51))
    assert not list(tmp_path.iterdir())


# --------------------------------------------------------------------- clusters


def test_slurm_is_asked_for_shards_and_for_a_last_job_that_plays_what_they_left(
    alone: Provenance, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A Slurm that keeps what is submitted: the first shard is played, the second one is lost."""
    slurm, root = FakeSlurm(tmp_path / "slurm", monkeypatch), tmp_path / "set"
    record_command(
        RecordConfig(num_episodes=COUNT, seed=50, root=root, shards=2, workers=1, executor="slurm",
                     slurm=SlurmConfig("cpu", "00:10:00", 3, qos="low", account="lab"))
    )  # fmt: skip
    told = capsys.readouterr().out
    shards, finish = (job for job in slurm.jobs if "launch_pickled_pipeline" in job.script)
    assert shards.options.items() >= {
        "partition": "cpu", "time": "00:10:00", "mem-per-cpu": "3G", "qos": "low", "account": "lab", "array": "0-1%1",
        "job-name": "hdril_record_shards", "kill-on-invalid-dep": "yes",
    }.items()  # fmt: skip
    assert "--dependency" not in shards.arguments
    assert "--dependency=afterany:100" in finish.arguments, "also after shards that failed"
    assert "Submitted 2 shards as job 100; job " in told
    assert not root.exists()
    shards.run(only=0)
    assert sorted(path.name for path in partial_folder(root).glob("*.npz")) == ["50.npz", "51.npz"]
    finish.run()
    assert read_provenance(root) == alone


def test_a_slurm_that_refuses_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slurm = FakeSlurm(tmp_path / "slurm", monkeypatch)
    slurm.program.write_text("#!/bin/sh\nexit 3\n")
    config = RecordConfig(num_episodes=1, root=tmp_path / "set", executor="slurm", slurm=SlurmConfig("cpu"))
    with pytest.raises(UserError, match=r"Slurm refused the jobs: .*exit status 3"):
        record_command(config)


def test_what_is_in_the_way_is_told_before_jobs_are_submitted(
    made_up: Callable[..., Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slurm, root = FakeSlurm(tmp_path / "slurm", monkeypatch), tmp_path / "set"
    config = RecordConfig(num_episodes=1, root=root, executor="slurm", slurm=SlurmConfig("cpu"))
    (tmp_path / "set.jobs").touch()  # where logs go
    with pytest.raises(OSError, match=r"set\.jobs"):
        record_command(config)
    (tmp_path / "set.jobs").unlink()
    Shards(partial_folder(root), RECIPE, 50).put(made_up(50))
    with pytest.raises(ValueError, match="holds episodes of another recipe"):
        record_command(config)
    assert not slurm.jobs


def _record(root: Path, *options: str) -> str:
    command = [Path(sys.executable).with_name("hdril-record"), "--task=table_lift", f"--num_episodes={COUNT}",
               "--seed=50", f"--root={root}", "--workers=2", *options]  # fmt: skip
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.mark.long
def test_ray_makes_the_same_dataset(alone: Provenance, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is an extra")
    _record(tmp_path / "set", "--executor=ray", "--shards=3")
    assert read_provenance(tmp_path / "set") == alone


def _break(rank: int, world_size: int) -> None:
    if rank == 1:
        raise ValueError("this shard cannot be done")


def _die(rank: int, world_size: int) -> None:
    if rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.long
@pytest.mark.parametrize(
    ("work", "why"),
    [(_break, "this shard cannot be done"), (_die, "a worker process was killed; it may need more memory")],
    ids=["it fails", "it is killed"],
)
def test_ray_says_which_shards_failed(work: Work, why: str, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is an extra")
    with pytest.raises(UserError, match=r"1 of 2 shards failed, the first is 1; their logs: .*/logs"):
        run_on_ray(work, 2, 1, tmp_path)
    assert why in (tmp_path / "logs/task_00001.log").read_text()


@pytest.mark.long
def test_slurm_makes_the_same_dataset(alone: Provenance, tmp_path: Path) -> None:
    root, partition = tmp_path / "set", real_partition()
    said = _record(root, "--executor=slurm", "--shards=3", f"--slurm.partition={partition}", "--slurm.mem_per_cpu_gb=1")
    assert "Submitted 3 shards as job " in said
    wait_until(root.exists)
    assert read_provenance(root) == alone
