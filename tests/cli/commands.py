"""The commands, run as a user runs them."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

BIN = Path(sys.executable).parent
REPO = Path(__file__).parents[2]


def call(*arguments: object, timeout: float = 400) -> subprocess.CompletedProcess[str]:
    """Run a command of the environment in the root of the checkout."""
    command = [str(BIN / str(arguments[0])), *map(str, arguments[1:])]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, cwd=REPO, check=False)


def succeed(*arguments: object) -> str:
    """Run a command that must succeed; returns all that it printed."""
    done = call(*arguments)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


def refuse(*arguments: object) -> str:
    """Run a command that must end with exit code 2 and a one-line error; returns the error, without the command's name."""
    done = call(*arguments)
    assert "Traceback" not in done.stderr, done.stderr[-3000:]
    assert done.returncode == 2, done.stderr[-3000:]
    name, word, message = done.stderr.strip().splitlines()[-1].split(": ", 2)
    assert (name, word) == (arguments[0], "error")
    return message


def train(dataset: Path, output: Path, *more: str) -> str:
    """Stock ``lerobot-train`` on small batches."""
    return succeed(
        "lerobot-train", "--config_path=configs/train/table_lift.yaml", f"--dataset.root={dataset}",
        f"--output_dir={output}", "--batch_size=16", "--num_workers=0", "--log_freq=1", *more,
    )  # fmt: skip


def start(*command: str, **options: Any) -> subprocess.Popen[str]:
    """Start a command in a session of its own. Ctrl-C reaches it even where the tests run in the background, which ignores it."""
    return subprocess.Popen(
        [str(BIN / command[0]), *command[1:]], text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **options,
    )  # fmt: skip
