"""Does one step in a process of its own, which ends with the one that started it, and takes the command with it.

``python -m hdril.benchmark.perform`` reads the step from standard input. When that is closed, the process that started it is
gone: a command that went on would write beside the one that is started next.
"""

from __future__ import annotations

import fcntl
import os
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any

from hdril.benchmark.steps import Folders, Step
from hdril.benchmark.store import DONE, LOG, RESULT, checkout_commit, is_done, mark_done
from hdril.digest import digest_json
from hdril.files import BusyError, exclusively, write_atomically

BUSY = os.EX_TEMPFAIL
"""Exit code if another process does the step."""
SPENT, RUNNING = "spent.txt", "running.lock"
"""Beside a result: how long a step has taken so far, s; and what its command holds as long as it runs."""
TICK = 1.0
"""s."""


@dataclass(frozen=True)
class Assignment:
    """A step, where it is done, and what it is made from."""

    step: Step
    place: Path
    inputs: Folders
    made_from: dict[str, Any]


def start(assignment: Assignment) -> subprocess.Popen[bytes]:
    """Start a process that does the step. Its exit code is 0, :data:`BUSY`, or that of the command that failed."""
    command = [sys.executable, "-m", "hdril.benchmark.perform"]
    # In a session of its own: whatever ends this process and its group leaves that one to end what it started.
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )
    assert process.stdin is not None
    process.stdin.write(pickle.dumps(assignment))
    process.stdin.flush()  # and stays open: that it is closed means that this process is gone
    return process


def perform(assignment: Assignment) -> int:
    """Do a step, unless it is done by now. Returns the exit code of its command.

    Raises:
        BusyError: another process does it.
        OSError, ValueError: the command succeeded, but its result is not whole; or what decides it was edited meanwhile.
    """
    step, place = assignment.step, assignment.place
    with exclusively(place, f"doing {step.title}"), _alone(place / RUNNING) as running:
        if is_done(place):
            return 0
        if (place / DONE).exists():  # somebody deleted the result
            (place / SPENT).unlink(missing_ok=True)
            (place / DONE).unlink()
        _check_unchanged(assignment)
        output, commit = place / RESULT, checkout_commit()
        if not step.resumes:
            shutil.rmtree(output, ignore_errors=True)
        command = step.command(output, assignment.inputs)
        # A result without step.json is whole if the process was killed between the two: the command would refuse it.
        with _stopwatch(place / SPENT, goes_on=step.resumes) as spent:
            code = 0 if step.resumes and output.exists() else _run(command, place / LOG, running)
        if code == 0:
            try:
                _check_unchanged(assignment)
                mark_done(place, step, assignment.made_from, shlex.join(command), spent(), commit)
            except ValueError:
                shutil.rmtree(output, ignore_errors=True)  # or it would be taken for a whole one the next time
                raise
            (place / SPENT).unlink(missing_ok=True)
        return code if code != BUSY else 1


def is_running(place: Path) -> bool:
    """Whether the command of a step runs, maybe without the process that started it."""
    try:
        with _alone(place / RUNNING):
            return False
    except FileNotFoundError:  # nobody was there
        return False
    except BusyError:
        return True


@contextmanager
def _alone(path: Path) -> Iterator[int]:
    """A lock for the command to hold as well, by its file descriptor: the command goes on if this process alone is killed.

    Raises:
        BusyError: it does.
    """
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BusyError(f"a command in {path.parent} outlived the process that started it; wait for it") from None
        yield file.fileno()


@contextmanager
def _stopwatch(file: Path, goes_on: bool) -> Iterator[Callable[[], float]]:
    """Seconds spent, with those of former attempts if the command goes on where it was. They are on disk at most
    :data:`TICK` seconds late, because a process that is killed cannot write them."""
    before = float(file.read_text() or 0.0) if goes_on and file.exists() else 0.0
    begun, over = time.monotonic(), Event()

    def spent() -> float:
        return before + time.monotonic() - begun

    def write() -> None:
        write_atomically(file, lambda stream: stream.write(f"{spent():.1f}".encode()))

    def keep() -> None:
        while not over.wait(TICK):
            write()

    thread = Thread(target=keep, daemon=True)
    thread.start()
    try:
        yield spent
    finally:
        over.set()
        thread.join()
        write()


def _check_unchanged(assignment: Assignment) -> None:
    """Raises ValueError if what decides the result is not what it was when the benchmark began: a file was edited.

    Sources are looked at once in this process, when they are loaded anyway; config files each time.
    """
    now, then = assignment.step.settings(), assignment.made_from["settings"]
    if digest_json(now) != digest_json(then):
        changed = ", ".join(sorted(key for key in then if digest_json(now.get(key)) != digest_json(then[key])))
        raise ValueError(f"{changed} changed while the benchmark ran: start it again")


def _run(command: list[str], log: Path, running: int) -> int:
    """Run a command, its output into the log, until it ends or the process that started this one is gone. The descriptor
    ``running`` stays open in it."""
    # The matrices are small: a second thread slows training down, and another step has the other processor.
    variables = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "HDRIL_DEBUG": "1"}
    # The programs of this environment, for what the command starts by name as well.
    variables["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    with log.open("ab") as file:
        file.write(f"$ {shlex.join(command)}\n".encode())
        file.flush()
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, env=variables, start_new_session=True,
            pass_fds=[running],
        )  # fmt: skip
    Thread(target=_end_with_parent, args=(process,), daemon=True).start()
    return process.wait()


def _end_with_parent(process: subprocess.Popen[bytes]) -> None:
    os.read(sys.stdin.fileno(), 1)  # not through sys.stdin, whose lock would be held when this process ends
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    os._exit(1)


def main() -> None:
    """Entry point."""
    try:
        code = perform(pickle.load(sys.stdin.buffer))
    except BusyError:
        code = BUSY
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    sys.exit(code)


if __name__ == "__main__":
    main()
