"""How many steps fit into minutes, measured on a made-up training."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hdril.benchmark.calibrate import SPEED, Speed, measure

TRAINING = """
import sys, time
from pathlib import Path
started, start, first, other, *options = sys.argv[1:]
print("imports", options)
time.sleep(float(start))
for step in range(1, 100_000):
    time.sleep(float(first) if step <= 3 else float(other))
    print(f"\\rTraining: 0%INFO 2026-01-01 in.py:1 step:{step if step < 1000 else '1K'} smpl:64 loss:0.1", flush=True)
    with Path(started).open("a") as file:
        file.write("step\\n")
"""


def training(tmp_path: Path, start: float, first: float, other: float) -> list[str]:
    """A command that needs ``start`` s, then ``first`` s for each of three steps, then ``other`` s a step, without end."""
    return [sys.executable, "-c", TRAINING, str(tmp_path / "steps"), str(start), str(first), str(other)]


def test_what_happens_once_is_left_out_of_the_speed_and_in_the_budget(tmp_path: Path) -> None:
    speed = measure(training(tmp_path, start=1.0, first=0.4, other=0.02), warm_up=0.9, measured=1.0)
    assert speed.warm_steps >= 4
    assert speed.warm_seconds >= 1.0 + 3 * 0.4
    assert 0.02 <= speed.step_seconds < 0.2, "a step of 0.4 s would show"
    begun = (tmp_path / "steps").read_text()
    time.sleep(0.3)
    assert (tmp_path / "steps").read_text() == begun, "the training is stopped"


def test_steps_are_those_that_are_over_by_then() -> None:
    speed = Speed(warm_steps=100, warm_seconds=60.0, step_seconds=0.5)
    assert [speed.steps(seconds) for seconds in (60.0, 60.5, 61.9, 600.0)] == [100, 101, 103, 1180]
    assert speed.steps(50.0) == 80
    assert speed.steps(1.0) == 1, "no training has no steps"


def test_a_training_that_ends_before_has_no_speed() -> None:
    with pytest.raises(ValueError, match="ended with exit code 3 after 1 steps"):
        measure([sys.executable, "-c", "print('step:1 smpl:1'); raise SystemExit(3)"], 1.0, 1.0)


def test_a_speed_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    for text in ("{", "{}", '{"warm_steps": 3}'):
        (tmp_path / SPEED).write_text(text)
        with pytest.raises(ValueError, match=r"speed\.json"):
            Speed.read(tmp_path / SPEED)


def test_the_command_writes_the_speed_and_nothing_else(tmp_path: Path) -> None:
    output = tmp_path / "result"
    command = [sys.executable, "-m", "hdril.benchmark.calibrate", f"--output={output}", "--warm_up=0.1", "--measured=0.2", "--",
               *training(tmp_path, 0.0, 0.01, 0.01), f"--output_dir={output / 'train'}"]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "imports" in done.stdout, "the log has what the training says"
    assert "step:" not in done.stdout, "but for thousands of steps"
    assert [path.name for path in output.iterdir()] == [SPEED]
    assert Speed.read(output / SPEED).warm_steps >= 2
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert f"{output} exists" in again.stderr
    assert (output / SPEED).exists(), "what is there is nobody's to remove"
    shutil.rmtree(output)
    failing = subprocess.run(
        [*command[: command.index("--") + 1], sys.executable, "-c", "raise SystemExit(2)"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert failing.returncode == 1
    assert "ended with exit code 2 after 0 steps" in failing.stderr
    assert not output.exists()
