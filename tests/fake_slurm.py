"""Slurm in tests: one that keeps what is submitted and runs it when the test says so, and the real one if there is any."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

SBATCH = """#!/bin/sh
# Keeps the script, which is the last argument, and the other arguments.
number=$((100 + $(ls "{folder}" | grep -c '\\.slurm$')))
for last; do :; done
cp "$last" "{folder}/$number.slurm"
echo "$@" > "{folder}/$number.arguments"
echo "Submitted batch job $number"
"""
SCONTROL = """#!/bin/sh
# scontrol show hostnames LIST, which a job asks for: here there is one node.
echo "$3"
"""


@dataclass(frozen=True)
class Job:
    """What was submitted."""

    script: str
    arguments: str

    @property
    def options(self) -> dict[str, str]:
        """The script's options of sbatch."""
        return dict(re.findall(r"^#SBATCH --([\w-]+)=(.*)$", self.script, re.MULTILINE))

    def run(self, only: int | None = None) -> None:
        """Run all ranks of the array, or only one; of datatrove's own jobs, none."""
        found = re.search(r"launch_pickled_pipeline \S+", self.script)
        if found is None:
            return
        first, last = map(int, self.options["array"].partition("%")[0].split("-"))
        for rank in range(first, last + 1) if only is None else [only]:
            variables = os.environ | {"SLURM_ARRAY_TASK_ID": str(rank), "SLURM_NODELIST": "localhost"}
            command = f". {self._environment} && {found[0]}"
            subprocess.run(["bash", "-c", command], env=variables, check=True, capture_output=True)

    @property
    def _environment(self) -> str:
        """What the script activates."""
        found = re.search(r"^source (\S+)$", self.script, re.MULTILINE)
        assert found is not None
        return found[1]


class FakeSlurm:
    """Stands for a cluster whose ``sbatch`` and ``scontrol`` are on the PATH."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self._kept = folder / "jobs"
        self._kept.mkdir(parents=True)
        self.program = folder / "bin" / "sbatch"
        self.program.parent.mkdir()
        for name, script in (("sbatch", SBATCH.format(folder=self._kept)), ("scontrol", SCONTROL)):
            program = self.program.with_name(name)
            program.write_text(script)
            program.chmod(0o755)
        patch.setenv("PATH", f"{self.program.parent}{os.pathsep}{os.environ['PATH']}")

    @property
    def jobs(self) -> list[Job]:
        """What was submitted, in order."""
        files = sorted(self._kept.glob("*.slurm"), key=lambda file: int(file.stem))
        return [Job(file.read_text(), file.with_suffix(".arguments").read_text()) for file in files]


def real_partition() -> str:
    """A partition of the Slurm that this machine belongs to; skips the test if there is none that answers."""
    if shutil.which("sinfo") is None:
        pytest.skip("there is no Slurm here")
    listed = subprocess.run(["sinfo", "-h", "-o", "%R"], capture_output=True, text=True, check=False)
    if listed.returncode or not listed.stdout.split():
        pytest.skip("there is no Slurm here that answers")
    return listed.stdout.split()[0]


def queued(folder: Path) -> list[str]:
    """Ids of the jobs that were submitted from ``folder`` and are not over in the real Slurm."""
    listed = subprocess.run(["squeue", "-h", "-o", "%i %Z"], capture_output=True, text=True, check=True).stdout
    return [line.split()[0] for line in listed.splitlines() if line.split(maxsplit=1)[1] == str(folder)]


def wait_until(happened: Callable[[], object], seconds: float = 300) -> None:
    """Wait for what a real cluster does; fails if it does not do it in time."""
    until = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < until, "a cluster did not do in time what the test waits for"
        time.sleep(0.1)
