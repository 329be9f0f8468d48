"""How many steps a training does in given minutes, by the first minutes of the same training.

``python -m hdril.benchmark.calibrate --output=FOLDER --warm_up=30 --measured=60 -- lerobot-train … --log_freq=1`` lets the
training run for so many seconds, stops it, and writes the speed into the folder.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from hdril.evaluation.checkpoint import read_json
from hdril.files import write_atomically

SPEED = "speed.json"
_STEP = re.compile(rb"\bstep:\S+ smpl:")
"""What lerobot-train prints after a step. The number itself is rounded (step:12K), so that steps are counted."""


@dataclass(frozen=True)
class Speed:
    """The first steps of a training."""

    warm_steps: int
    """Steps until the end of the warm-up."""
    warm_seconds: float
    """s from the start of the command until then: imports, and what is done once in the first steps, are in here alone."""
    step_seconds: float
    """s a step from then on."""

    def steps(self, seconds: float) -> int:
        """How many steps a command does that ends after ``seconds``; at least one."""
        return max(1, self.warm_steps + int((seconds - self.warm_seconds) / self.step_seconds))

    @staticmethod
    def read(path: Path) -> Speed:
        """The speed in a file.

        Raises:
            OSError, ValueError: there is none, or the file is damaged.
        """
        values = read_json(path)
        if set(values) != {field.name for field in fields(Speed)}:
            raise ValueError(f"{path} holds no speed of a training")
        return Speed(**values)


def measure(command: Sequence[str], warm_up: float, measured: float) -> Speed:
    """Run a training until it has told of steps for ``warm_up`` and then for ``measured`` seconds; its output goes to ours.

    Raises:
        ValueError: the training ended before.
    """
    begun = time.monotonic()
    count, first, warm = 0, None, None
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if not _STEP.search(line):
                    sys.stdout.buffer.write(line)
                    sys.stdout.flush()
                    continue
                count, now = count + 1, time.monotonic()
                first = first or now
                if warm is None:
                    warm = (count, now) if now - first >= warm_up else None
                elif now - warm[1] >= measured:
                    steps, since = warm
                    return Speed(steps, round(since - begun, 3), round((now - since) / (count - steps), 6))
            code = process.wait()
        finally:
            process.kill()
    raise ValueError(f"the training ended with exit code {code} after {count} steps: it is too short, or it failed")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--warm_up", type=float, required=True)
    parser.add_argument("--measured", type=float, required=True)
    parser.add_argument("command", nargs="+")
    told = parser.parse_args()
    if told.output.exists():
        parser.error(f"{told.output} exists")
    try:
        speed = measure(told.command, told.warm_up, told.measured)
    except ValueError as error:
        sys.exit(str(error))
    finally:
        shutil.rmtree(told.output, ignore_errors=True)  # what the training wrote in there
    write_atomically(told.output / SPEED, lambda file: file.write(json.dumps(vars(speed)).encode()))


if __name__ == "__main__":
    main()
