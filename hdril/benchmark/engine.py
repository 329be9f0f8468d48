"""Does the steps that are not done, several at a time, in an order in which each has its inputs."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from hdril.benchmark.perform import BUSY, Assignment, is_running, start
from hdril.benchmark.steps import Step
from hdril.benchmark.store import LOG, Store
from hdril.errors import UserError
from hdril.files import is_busy

POLL = 0.2
"""s until the running steps are looked at again."""
PATIENCE = 2.0
"""s until a step that another process does is looked at again."""


def in_order(steps: Iterable[Step]) -> list[Step]:
    """The steps and all that they are made from, each once and after its inputs."""
    ordered: dict[Step, None] = {}

    def add(step: Step) -> None:
        if step not in ordered:
            for other in step.inputs.values():
                add(other)
            ordered[step] = None

    for step in steps:
        add(step)
    return list(ordered)


@dataclass
class Progress:
    """What is done and what is left."""

    jobs: int
    """Steps at a time."""
    fresh: bool = False
    """Whether the step that is told of was done just now, and not before."""
    done: dict[str, tuple[float, float]] = field(default_factory=dict)
    """By unit (:attr:`Step.effort`): how much is done, and the seconds that it took."""
    left: dict[str, float] = field(default_factory=dict)
    """By unit: how much is left."""

    @staticmethod
    def of(steps: Iterable[Step], jobs: int) -> Progress:
        """Nothing of the steps is done."""
        progress = Progress(jobs)
        for step in steps:
            unit, effort = step.effort
            progress.left[unit] = progress.left.get(unit, 0.0) + effort
        return progress

    def settle(self, step: Step, seconds: float | None) -> None:
        """A step is done, which took so long, or cannot be done (None)."""
        unit, effort = step.effort
        self.left[unit] -= effort
        if seconds is not None:
            before, took = self.done.get(unit, (0.0, 0.0))
            self.done[unit] = (before + effort, took + seconds)

    def remaining(self) -> float | None:
        """Seconds until all is done, by the mean speed of each unit; None while there is a unit of which nothing is known."""
        waiting = {unit: effort for unit, effort in self.left.items() if effort > 0.0}
        if not waiting.keys() <= self.done.keys():
            return None
        return sum(effort * self.done[unit][1] / self.done[unit][0] for unit, effort in waiting.items()) / self.jobs


Watch = Callable[[Step, Progress], object]
"""Told of each step that is done by now."""


@dataclass
class _Running:
    step: Step
    process: subprocess.Popen[bytes]


class Engine:
    """Does steps, ``jobs`` at a time. Any number of engines may share a store, on machines that share the disk."""

    def __init__(self, store: Store, jobs: int, watch: Watch | None = None) -> None:
        self._store, self._jobs, self._watch = store, jobs, watch or (lambda step, progress: None)
        self._running: list[_Running] = []
        self._failed: dict[Step, str] = {}
        self._later: dict[Step, float] = {}

    def run(self, steps: Iterable[Step]) -> None:
        """Do all steps that are not done, and all that they are made from.

        A step that fails keeps back only those that are made from it.

        Raises:
            UserError: steps failed; names them, and where the log of the first is.
        """
        left = in_order(steps)
        progress = Progress.of(left, self._jobs)
        try:
            left = self._settle(left, progress)
            progress.fresh = True
            while left:
                self._begin(left)
                time.sleep(POLL)
                left = self._settle(left, progress)
        finally:
            self._end()
        if self._failed:
            first, why = next(iter(self._failed.items()))
            others = f" (and {len(self._failed) - 1} more)" if len(self._failed) > 1 else ""
            raise UserError(f"a step failed: {first.title}{others}: {why}")

    def _settle(self, left: Sequence[Step], progress: Progress) -> list[Step]:
        """What is left after those steps that are done by now, and those that cannot be done."""
        for running in [entry for entry in self._running if entry.process.poll() is not None]:
            self._running.remove(running)
            code, told = running.process.returncode, running.process.communicate()[1]
            if code == BUSY:
                self._later[running.step] = time.monotonic() + PATIENCE
            elif code:
                self._failed[running.step] = self._reason(running.step, told)
        still = []
        busy = {entry.step for entry in self._running}
        for step in left:
            if step in busy or (done := self._store.find(step)) is None:
                if any(other in self._failed for other in in_order([step])):
                    progress.settle(step, None)
                else:
                    still.append(step)
                continue
            progress.settle(step, done.seconds)
            self._watch(step, progress)
        return still

    def _reason(self, step: Step, told: bytes) -> str:
        place = self._store.place(step)
        last = told.decode(errors="replace").strip().splitlines()[-1:]
        return f"see {place}/{LOG}" + (f" ({last[0]})" if last else "")

    def _begin(self, left: Sequence[Step]) -> None:
        """Start steps whose inputs are there, the first ones first."""
        busy, now = {entry.step for entry in self._running}, time.monotonic()
        for step in left:
            if len(self._running) >= self._jobs:
                return
            if step in busy or self._later.get(step, 0.0) > now:
                continue
            place, made_from = self._store.place(step), self._store.made_from(step)
            if place is None or made_from is None:
                continue
            if is_busy(place) or is_running(place):  # another engine does it, or a command that outlived its process
                self._later[step] = now + PATIENCE
                continue
            assignment = Assignment(step, place, self._store.input_folders(step), made_from)
            self._running.append(_Running(step, start(assignment)))

    def _end(self) -> None:
        """End what still runs: closing its standard input tells it that nobody waits for it."""
        for running in self._running:
            assert running.process.stdin is not None
            running.process.stdin.close()
        for running in self._running:
            running.process.wait()
        self._running.clear()
