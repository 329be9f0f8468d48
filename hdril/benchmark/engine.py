"""Does the steps that are not done, several at a time, in an order in which each has its inputs."""

from __future__ import annotations

import subprocess
import time
from collections import Counter
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
    seconds: dict[str, list[float]] = field(default_factory=dict)
    """How long steps of each kind took."""
    left: dict[str, int] = field(default_factory=dict)
    """How many steps of each kind are left."""

    def remaining(self) -> float | None:
        """Seconds until all is done, by the mean of each kind; None while there is a kind of which nothing is known."""
        if any(count and not self.seconds.get(kind) for kind, count in self.left.items()):
            return None
        means = {kind: sum(took) / len(took) for kind, took in self.seconds.items() if took}
        return sum(count * means[kind] for kind, count in self.left.items() if count) / self.jobs


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
        progress = Progress(self._jobs, left=dict(Counter(step.kind for step in left)))
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
                    progress.left[step.kind] -= 1
                else:
                    still.append(step)
                continue
            progress.left[step.kind] -= 1
            progress.seconds.setdefault(step.kind, []).append(done.seconds)
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
