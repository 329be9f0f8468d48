"""Outcomes of an evaluation that is not finished: written as they come, and gone on with by the same evaluation alone."""

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
from hdril.files import exclusively

_RUN, _OUTCOMES, _LOCK = "run.json", "outcomes.jsonl", "lock"


class Journal:
    """The folder ``<output>.partial``, which becomes ``output`` when the evaluation is finished.

    Raises:
        ValueError: there is an unfinished evaluation of something else; says what differs.
    """

    def __init__(self, output: Path, identity: Identity) -> None:
        self.output, self.folder = output, output.with_name(output.name + ".partial")
        self._identity = identity
        self.done: dict[int, Outcome] = {}
        """Outcomes by seed: those of before, and those that were added."""
        if (self.folder / _RUN).exists():
            stored = read_json(self.folder / _RUN).get("identity")
            require_same(str(self.folder), stored, identity.as_dict(), "delete it or choose another output_dir")
            self.done = {outcome.seed: outcome for outcome in _read_outcomes(self.folder / _OUTCOMES)}
        elif self.folder.exists() and any(path.name != _LOCK for path in self.folder.iterdir()):
            raise FileExistsError(f"{self.folder} exists and is no evaluation; delete it or choose another output_dir")

    @contextmanager
    def writing(self) -> Iterator[Callable[[Outcome], None]]:
        """Gives a function that adds an outcome. If the evaluation fails before there is one, nothing is left behind.

        Raises:
            BusyError: another process writes here.
        """
        missing = [path for path in self.folder.parents if not path.exists()]
        # A process that is kept out must not remove what the other one writes: the cleaning is done under the lock.
        with exclusively(self.folder, f"evaluating into {self.output}"):
            try:
                (self.folder / _RUN).write_text(json.dumps({"identity": self._identity.as_dict()}, indent=2))
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
        """Everything is written: the folder becomes the output."""
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
        yield Outcome(**values)
