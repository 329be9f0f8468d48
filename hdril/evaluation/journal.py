"""Outcomes of an evaluation that is not finished: kept as they come, so that the same evaluation can go on after a break."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hdril.evaluation.checkpoint import read_json
from hdril.evaluation.identity import Identity, require_same
from hdril.evaluation.score import Outcome
from hdril.files import exclusively, write_atomically

_RUN, _OUTCOMES, _LOCK = "run.json", "outcomes.jsonl", "lock"


class Journal:
    """An unfinished evaluation: the folder ``<output>.partial``, which :meth:`finish` renames to ``output``.

    ``run.json`` holds what is evaluated, ``outcomes.jsonl`` a line for each episode that was played. Nothing is written before
    :meth:`writing`.

    Raises:
        ValueError: the folder holds an unfinished evaluation of something else; names what differs.
        FileExistsError: ``output`` exists, or the folder holds something that is no evaluation.
    """

    def __init__(self, output: Path, identity: Identity) -> None:
        self.output, self.folder = output, output.with_name(output.name + ".partial")
        self._identity = identity
        self.done: dict[int, Outcome] = {}
        """Outcomes by seed: those of before, and those that were added."""
        self._read()

    def _read(self) -> None:
        if self.output.exists():
            raise FileExistsError(f"{self.output} exists; choose another output_dir or delete it")
        if (self.folder / _RUN).exists():
            stored = read_json(self.folder / _RUN).get("identity")
            require_same(str(self.folder), stored, self._identity.as_dict(), "delete it or choose another output_dir")
            self.done = {outcome.seed: outcome for outcome in _read_outcomes(self.folder / _OUTCOMES)}
        elif self.folder.exists() and any(path.name != _LOCK for path in self.folder.iterdir()):
            raise FileExistsError(f"{self.folder} exists and is no evaluation; delete it or choose another output_dir")

    @contextmanager
    def writing(self) -> Iterator[Callable[[Outcome], None]]:
        """Gives a function that adds an outcome, and reads :attr:`done` anew. Other processes are kept out until the end.

        If the evaluation fails before there is an outcome, nothing is left behind.

        Raises:
            BusyError: another process writes here.
            ValueError, FileExistsError: as for the class, if another process wrote here since.
        """
        missing = [path for path in self.folder.parents if not path.exists()]
        # A process that is kept out must not remove what the other one writes: the cleaning is done under the lock.
        with exclusively(self.folder, f"evaluating into {self.output}"):
            try:
                self._read()
            except (ValueError, FileExistsError):
                if [path.name for path in self.folder.iterdir()] == [_LOCK]:  # made here, by the lock
                    self._remove(missing)
                raise
            try:
                run = json.dumps({"identity": self._identity.as_dict()}, indent=2)
                write_atomically(self.folder / _RUN, lambda file: file.write(run.encode()))
                with (self.folder / _OUTCOMES).open("a") as file:

                    def add(outcome: Outcome) -> None:
                        file.write(json.dumps(asdict(outcome)) + "\n")
                        file.flush()
                        self.done[outcome.seed] = outcome

                    yield add
            except BaseException:
                if not self.done:
                    self._remove(missing)
                raise

    def _remove(self, made: list[Path]) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        for path in made:  # the innermost first
            if path.exists() and not any(path.iterdir()):
                path.rmdir()

    def finish(self) -> None:
        """Rename the folder to the output: all is written. Call it within :meth:`writing`, which keeps others out."""
        for name in (_RUN, _OUTCOMES, _LOCK):
            (self.folder / name).unlink(missing_ok=True)
        self.folder.replace(self.output)


def _read_outcomes(path: Path) -> Iterator[Outcome]:
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            values: dict[str, Any] = json.loads(line)
        except json.JSONDecodeError:
            return  # the process ended while it wrote the last line: that seed is played again
        for name in ("start", "primitives"):
            values[name] = tuple(values[name])
        values["events"] = tuple((frame, event) for frame, event in values["events"])
        yield Outcome(**values)
