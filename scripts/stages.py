"""The commands that the scripts of this folder run one after the other, each skipped when its result is there.

A result is kept only while it was made by the same command from the same input files: next to each output folder is a file
``<folder>.made_from`` that says what it is made from. So a policy that was trained again is evaluated again.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Stage:
    """A command, the folder that it writes, and the file in there that is present when it is done."""

    title: str
    command: tuple[str, ...]
    output: Path
    result: Path
    inputs: tuple[Path, ...] = ()
    """Files that the result is made from."""
    threads: int | None = None
    """Threads of PyTorch; PyTorch's own choice unless given."""
    resumes: bool = True
    """Whether the command continues where it was interrupted. If not, what it left is removed before it runs again."""

    def run(self) -> float:
        """Run the command unless its result is there.

        Returns:
            Seconds it took; 0 if it was done before.

        Raises:
            subprocess.CalledProcessError: the command failed.
            FileNotFoundError: an input is missing.
        """
        variables = {} if self.threads is None else {"OMP_NUM_THREADS": str(self.threads)}
        prefix = "".join(f"{name}={value} " for name, value in variables.items())
        print(f"\n== {self.title}\n$ {prefix}{shlex.join(self.command)}", flush=True)
        made_from = self._made_from()
        same = self._record.exists() and self._record.read_text() == made_from
        if same and self.result.exists():
            print(f"done before: {self.result}")
            return 0.0
        if not (same and self.resumes):
            self._remove(made_from)
        start = time.monotonic()
        program = Path(sys.executable).with_name(self.command[0])
        subprocess.run([program, *self.command[1:]], check=True, env=os.environ | variables)
        return time.monotonic() - start

    @property
    def _record(self) -> Path:
        return self.output.with_name(f"{self.output.name}.made_from")

    def _made_from(self) -> str:
        """The command and the digests of the inputs, as JSON. The number of workers changes no result and is left out."""
        command = [argument for argument in self.command if not argument.startswith("--workers=")]
        digests = {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in self.inputs}
        return json.dumps({"command": command, "inputs": digests}, indent=1)

    def _remove(self, made_from: str) -> None:
        """Remove the result of something else and the rest of an interrupted run, and record what is made now."""
        if self.result.exists():
            print(f"made from something else, made again: {self.output}", flush=True)
        for folder in (self.output, self.output.with_name(f"{self.output.name}.partial")):
            shutil.rmtree(folder, ignore_errors=True)
        self._record.parent.mkdir(parents=True, exist_ok=True)
        self._record.write_text(made_from)


def checkpoint(train: Path, steps: int) -> Path:
    """Where ``lerobot-train`` leaves the policy after so many steps."""
    return train / "checkpoints" / f"{steps:06d}" / "pretrained_model"


def weights(policy: Path) -> tuple[Path, ...]:
    """The files that make a checkpoint the policy that it is."""
    return policy / "model.safetensors", policy / "config.json"


def record_stage(task: str, repo_id: str, root: Path, episodes: int) -> Stage:
    """Demonstrations of seeds 0 to ``episodes`` - 1."""
    return Stage(
        f"{episodes} demonstrations",
        ("hdril-record", f"--task={task}", f"--repo_id={repo_id}", f"--root={root}", f"--num_episodes={episodes}"),
        root,
        root / "meta" / "info.json",
    )


def train_stage(
    title: str, config: str, dataset: Path, train: Path, steps: int, *options: str, save_every: int = 0
) -> Stage:
    """Stock ``lerobot-train`` with ``configs/{config}.yaml``.

    An interrupted training starts again from the beginning: ``lerobot-train`` refuses the folder that it left.
    """
    return Stage(
        f"{title}: training, {steps} steps",
        ("lerobot-train", f"--config_path=configs/{config}.yaml", f"--dataset.root={dataset}",
         f"--output_dir={train}", f"--steps={steps}", f"--save_freq={save_every or steps}", *options),
        train,
        checkpoint(train, steps) / "model.safetensors",
        (Path("configs") / f"{config}.yaml", dataset / "meta" / "info.json", dataset / "meta" / "stats.json"),
        threads=1,  # the matrices are small: a second thread slows training down
        resumes=False,
    )  # fmt: skip


def evaluation_stage(
    title: str, task: str, policy: Path, output: Path, episodes: int, seed: int, *options: str, workers: int = 1
) -> Stage:
    """``hdril-eval`` on ``episodes`` seeds from ``seed`` on."""
    return Stage(
        f"{title}: {episodes} seeds",
        ("hdril-eval", f"--policy.path={policy}", f"--task={task}", f"--num_episodes={episodes}", f"--seed={seed}",
         "--rerun=none", f"--workers={workers}", f"--output_dir={output}", *options),
        output,
        output / "results.json",
        weights(policy),
    )  # fmt: skip


def run_chains(chains: Iterable[list[Stage]], jobs: int = 1) -> None:
    """Run the stages of each chain in order, ``jobs`` chains at a time.

    Raises:
        SystemExit: a command failed, or Ctrl-C; says which.
    """
    script = Path(sys.argv[0]).stem

    def run(chain: list[Stage]) -> None:
        for stage in chain:
            stage.run()

    try:
        with ThreadPoolExecutor(jobs) as pool:
            list(pool.map(run, chains))
    except subprocess.CalledProcessError as error:
        sys.exit(
            f"{script}: {Path(error.cmd[0]).name} failed with exit code {error.returncode}; run its command to see why"
        )
    except KeyboardInterrupt:
        sys.exit(f"\n{script}: interrupted; run it again to continue")


def commit() -> str:
    """Short hash of the checkout that the scripts belong to."""
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    return done.stdout.strip()
