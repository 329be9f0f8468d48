"""The commands that the scripts of this folder string together, each skipped when its result is there."""

from __future__ import annotations

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
    """A command and the file that is there when it is done."""

    title: str
    command: tuple[str, ...]
    result: Path
    threads: int | None = None
    """Threads of PyTorch; as many as it likes unless given."""
    fresh: Path | None = None
    """A folder that is removed before the command runs."""

    def run(self) -> float:
        """Seconds it took; 0 if it was done before.

        Raises:
            subprocess.CalledProcessError: the command failed.
        """
        variables = {} if self.threads is None else {"OMP_NUM_THREADS": str(self.threads)}
        prefix = "".join(f"{name}={value} " for name, value in variables.items())
        print(f"\n== {self.title}\n$ {prefix}{shlex.join(self.command)}", flush=True)
        if self.result.exists():
            print(f"done before: {self.result}")
            return 0.0
        if self.fresh is not None:
            shutil.rmtree(self.fresh, ignore_errors=True)
        start = time.monotonic()
        program = Path(sys.executable).with_name(self.command[0])
        subprocess.run([program, *self.command[1:]], check=True, env=os.environ | variables)
        return time.monotonic() - start


def checkpoint(train: Path, steps: int) -> Path:
    """Where ``lerobot-train`` leaves the policy after so many steps."""
    return train / "checkpoints" / f"{steps:06d}" / "pretrained_model"


def record_stage(task: str, repo_id: str, root: Path, episodes: int) -> Stage:
    """Demonstrations of seeds 0 to ``episodes`` - 1."""
    return Stage(
        f"{episodes} demonstrations",
        ("hdril-record", f"--task={task}", f"--repo_id={repo_id}", f"--root={root}", f"--num_episodes={episodes}"),
        root / "meta" / "info.json",
    )


def train_stage(
    title: str, config: str, dataset: Path, train: Path, steps: int, *options: str, save_every: int = 0
) -> Stage:
    """Stock ``lerobot-train`` with ``configs/{config}.yaml``. A training that was cut off before its end starts anew:
    ``lerobot-train`` refuses the folder that it left."""
    return Stage(
        f"{title}: training, {steps} steps",
        ("lerobot-train", f"--config_path=configs/{config}.yaml", f"--dataset.root={dataset}",
         f"--output_dir={train}", f"--steps={steps}", f"--save_freq={save_every or steps}", *options),
        checkpoint(train, steps) / "model.safetensors",
        threads=1,  # the matrices are small: a second thread slows them down
        fresh=train,
    )  # fmt: skip


def evaluation_stage(
    title: str, task: str, policy: Path, output: Path, episodes: int, seed: int, *options: str, workers: int = 1
) -> Stage:
    """``hdril-eval`` on ``episodes`` seeds from ``seed`` on; it goes on by itself where it was cut off."""
    return Stage(
        f"{title}: {episodes} seeds",
        ("hdril-eval", f"--policy.path={policy}", f"--task={task}", f"--num_episodes={episodes}", f"--seed={seed}",
         "--rerun=none", f"--workers={workers}", f"--output_dir={output}", *options),
        output / "results.json",
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
        sys.exit(f"\n{script}: interrupted; run it again to go on")


def commit() -> str:
    """Short hash of the checkout that the scripts belong to."""
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    return done.stdout.strip()
