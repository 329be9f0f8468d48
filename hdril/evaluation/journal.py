"""Outcomes of an evaluation that is not finished: kept as they come, so that the same evaluation can go on after a break."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hdril.evaluation.identity import Identity
from hdril.evaluation.score import Outcome
from hdril.evaluation.unfinished import UnfinishedFolder

_OUTCOMES = "outcomes.jsonl"


class Journal:
    """An unfinished evaluation, in an :class:`~hdril.evaluation.unfinished.UnfinishedFolder`.

    ``run.json`` holds what is evaluated, ``outcomes.jsonl`` a line for each episode that was played. Nothing is written before
    :meth:`writing`.

    Raises:
        ValueError: the folder holds an unfinished evaluation of something else; names what differs.
        FileExistsError: ``output`` exists, or the folder holds something that is no evaluation.
    """

    def __init__(self, output: Path, identity: Identity) -> None:
        self._unfinished = UnfinishedFolder(output, "evaluation", "run.json", identity.as_dict(), key="identity")
        self.folder = self._unfinished.folder
        self.done = self._read()
        """Outcomes by seed: those of before, and those that were added."""

    def _read(self) -> dict[int, Outcome]:
        return {outcome.seed: outcome for outcome in _read_outcomes(self.folder / _OUTCOMES)}

    @contextmanager
    def writing(self) -> Iterator[Callable[[Outcome], None]]:
        """Gives a function that adds an outcome, and reads :attr:`done` anew. Other processes are kept out until the end.

        If the evaluation fails before there is an outcome, nothing is left behind.

        Raises:
            BusyError: another process writes here.
            ValueError, FileExistsError: as for the class, if another process wrote here since.
        """
        # Files count, too: what another process played since must stay if it cannot be read.
        with self._unfinished.writing(begun=lambda: bool(self.done or self._read())):
            self.done = self._read()
            with (self.folder / _OUTCOMES).open("a") as file:

                def add(outcome: Outcome) -> None:
                    file.write(json.dumps(asdict(outcome)) + "\n")
                    file.flush()
                    self.done[outcome.seed] = outcome

                yield add

    def finish(self) -> None:
        """Rename the folder to the output: all is written. Call it within :meth:`writing`, which keeps others out.

        Raises:
            OSError: a file, or a folder that is not empty, is at the output by now; the folder stays.
        """
        self._unfinished.finish(_OUTCOMES)


def _read_outcomes(path: Path) -> Iterator[Outcome]:
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            values: dict[str, Any] = json.loads(line)
        except json.JSONDecodeError:
            return  # the process ended while it wrote the last line: that seed is played again
        for name in ("start", "primitives"):
            values[name] = tuple(values[name])
        for name in ("events", "noticed"):
            values[name] = tuple((frame, words) for frame, words in values[name])
        yield Outcome(**values)
