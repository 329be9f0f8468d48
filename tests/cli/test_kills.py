"""SIGKILL at a random moment, again and again: the same command goes on, and ends with the same bits and nothing else."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from hdril.demonstrations.provenance import read_provenance
from tests.evaluation.checkpoints import listing, save_hdril

KILLS, EPISODES = 10, 40

Command = Callable[[Path], list[str]]
"""The arguments of a command that writes to a folder."""


def program(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


def recording(output: Path) -> list[str]:
    return [program("hdril-record"), f"--num_episodes={EPISODES}", f"--root={output}", "--workers=2"]


def worker_of(process: subprocess.Popen[bytes]) -> psutil.Process | None:
    """One of the processes that play, if there is one by now."""
    try:
        family = psutil.Process(process.pid).children(recursive=True)
        workers = [
            child for child in family if "forkserver" in " ".join(child.cmdline()) and child.ppid() != process.pid
        ]
    except psutil.NoSuchProcess:
        return None
    return random.choice(workers) if workers else None


def run_and_kill(command: list[str], seconds: float, whole: bool) -> int:
    """Start a command and kill it, or one of its workers, after so long unless it is done; returns the exit code."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        return process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        victim = None if whole else worker_of(process)
        if victim is None:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            victim.kill()
        return process.wait(timeout=60)


def torment(command: Command, output: Path) -> list[int]:
    """Kill the command ten times, then let it end. Returns the exit codes."""
    random.seed(20)
    codes = []
    for number in range(KILLS):
        # Long enough for the command to start; what is played before the kill stays.
        codes.append(run_and_kill(command(output), random.uniform(3.0, 12.0), whole=number % 2 == 0))
        if output.exists():
            break
    if not output.exists():
        codes.append(subprocess.run(command(output), check=True, capture_output=True).returncode)
    return codes


@pytest.mark.long
def test_a_recording_that_is_killed_again_and_again(tmp_path: Path) -> None:
    subprocess.run(recording(tmp_path / "calm/set"), check=True, capture_output=True)
    codes = torment(recording, tmp_path / "killed/set")
    assert -signal.SIGKILL in codes, "the whole was killed"
    assert 2 in codes, "a worker was killed, and the command said so"
    assert read_provenance(tmp_path / "killed/set") == read_provenance(tmp_path / "calm/set")
    assert listing(tmp_path / "killed/set") == listing(tmp_path / "calm/set")
    assert [path.name for path in (tmp_path / "killed").iterdir()] == ["set"], "nothing is left beside it"


@pytest.mark.long
def test_shards_that_are_killed_again_and_again(tmp_path: Path) -> None:
    """Each kill ends whatever shard plays then; every shard has its turn, and the last command plays what is missing."""
    subprocess.run(recording(tmp_path / "calm/set"), check=True, capture_output=True)
    output, turn = tmp_path / "killed/set", iter(range(1000))
    codes = torment(lambda root: [*recording(root), "--shards=7", f"--shard={next(turn) % 7}"], output)
    assert -signal.SIGKILL in codes
    subprocess.run(recording(output), check=True, capture_output=True)
    assert listing(output) == listing(tmp_path / "calm/set")
    assert [path.name for path in output.parent.iterdir()] == ["set"]


@pytest.mark.long
def test_an_evaluation_that_is_killed_again_and_again(dataset: Path, tmp_path: Path) -> None:
    policy = save_hdril(tmp_path / "policy", dataset)

    def command(output: Path) -> list[str]:
        return [program("hdril-eval"), f"--policy.path={policy}", f"--num_episodes={EPISODES}", "--seed=930000",
                "--rerun=5", f"--output_dir={output}", "--workers=2"]  # fmt: skip

    codes = torment(command, tmp_path / "killed/eval")
    assert -signal.SIGKILL in codes
    assert 2 in codes, "a worker was killed, and the command said so"
    subprocess.run(command(tmp_path / "calm/eval"), check=True, capture_output=True)
    calm, killed = (listing(tmp_path / name / "eval") for name in ("calm", "killed"))
    assert set(killed) == set(calm)
    for name, data in calm.items():
        if not name.endswith(".rrd"):  # recordings hold the time at which they were made
            assert killed[name] == data, name
    assert [path.name for path in (tmp_path / "killed").iterdir()] == ["eval"]
