"""Outcomes of an evaluation that is not finished: kept as they come, so that the same evaluation can go on after a break."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hdril.errors import UserError
from hdril.evaluation.identity import Identity
from hdril.evaluation.score import Outcome
from hdril.evaluation.unfinished import UnfinishedFolder
from hdril.files import exclusively, naming, write_atomically

_OUTCOMES, _SHARDS = "outcomes.jsonl", "shards"


class Journal:
    """An unfinished evaluation, in an :class:`~hdril.evaluation.unfinished.UnfinishedFolder`.

    ``run.json`` holds what is evaluated, ``outcomes.jsonl`` a line for each episode that was played, and
    ``shards/*/outcomes.jsonl`` those of processes that play shares of the seeds. Nothing is written before :meth:`writing` or
    :meth:`sharing`.

    Raises:
        ValueError: the folder holds an unfinished evaluation of something else; names what differs.
        FileExistsError: ``output`` exists, or the folder holds something that is no evaluation.
    """

    def __init__(self, output: Path, identity: Identity) -> None:
        self._unfinished = UnfinishedFolder(output, "evaluation", "run.json", identity.as_dict(), key="identity")
        self.folder = self._unfinished.folder
        self.done = self._read()
        """Outcomes by seed: those of before, and those that were added."""

    def _read(self, tell: bool = False) -> dict[int, Outcome]:
        files = [self.folder / _OUTCOMES, *sorted((self.folder / _SHARDS).glob(f"*/{_OUTCOMES}"))]
        return {outcome.seed: outcome for path in files for outcome in _read_outcomes(path, tell)}

    @contextmanager
    def writing(self) -> Iterator[Callable[[Outcome], None]]:
        """Gives a function that adds an outcome, and reads :attr:`done` anew. Other processes are kept out until the end.

        If the evaluation fails before there is an outcome, nothing is left behind.

        Raises:
            BusyError: another process writes here.
            ValueError, FileExistsError: as for the class, if another process wrote here since.
        """
        with self._unfinished.writing(begun=self._begun):
            self.done = self._read(tell=True)
            yield self._appender(self.folder / _OUTCOMES)

    def _begun(self) -> bool:
        """Whether something was played, by whatever process and though it cannot be read."""
        path = self.folder / _OUTCOMES
        return (self.folder / _SHARDS).exists() or (path.exists() and b"\n" in path.read_bytes())

    @contextmanager
    def sharing(self, shard: int, shards: int) -> Iterator[Callable[[Outcome], None]]:
        """As :meth:`writing`, for one of ``shards`` processes that play their shares at the same time.

        Raises:
            BusyError: another process plays this share.
            ValueError, FileExistsError: as for the class, if another process wrote here since.
            UserError: while adding; the folder was removed, because another process finished the evaluation.
        """
        self._unfinished.begin_share()
        folder = self.folder / _SHARDS / f"{shard}-of-{shards}"
        with exclusively(folder, f"playing shard {shard} of {shards}"):
            self.done = self._read(tell=True)
            yield self._appender(folder / _OUTCOMES)

    def _appender(self, path: Path) -> Callable[[Outcome], None]:
        """A function that adds an outcome to a file of outcomes."""
        _drop_half_line(path)
        path.touch()

        def add(outcome: Outcome) -> None:
            try:
                # Opened each time: a file that is closed later tells of a full disk once more, and in another context.
                with naming(path), path.open("r+") as file:  # which makes no file
                    file.seek(0, os.SEEK_END)
                    file.write(json.dumps(asdict(outcome)) + "\n")
            except FileNotFoundError:
                told = f"{path.parent} was removed by another process, which finished the evaluation or gave it up"
                raise UserError(told) from None
            self.done[outcome.seed] = outcome

        return add

    def finish(self) -> None:
        """Rename the folder to the output: all is written. Call it within :meth:`writing`, which keeps others out.

        Raises:
            OSError: a file, or a folder that is not empty, is at the output by now; the folder stays.
        """
        self._unfinished.finish(_OUTCOMES, _SHARDS)


def _drop_half_line(path: Path) -> None:
    """Cut off what a process had written of a line when it ended: what is added must not be appended to that."""
    text = path.read_bytes() if path.exists() else b""
    if text and not text.endswith(b"\n"):
        write_atomically(path, lambda file: file.write(text[: text.rfind(b"\n") + 1]))


def _read_outcomes(path: Path, tell: bool) -> Iterator[Outcome]:
    """Outcomes of all lines that can be read, and on request a message about each that cannot: its episode is played again."""
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    for number, line in enumerate(lines, 1):
        try:
            yield _outcome(json.loads(line))
        except (ValueError, TypeError, KeyError) as error:
            if tell and line.endswith(b"\n"):  # else the process ended while it wrote the last line
                why = f"{path}, line {number} is damaged: {error}"
                print(f"{why}; the episode is played again", file=sys.stderr, flush=True)


def _outcome(values: dict[str, Any]) -> Outcome:
    for name in ("start", "primitives", "expert_primitives"):
        values[name] = tuple(values[name])
    for name in ("events", "noticed"):
        values[name] = tuple((frame, words) for frame, words in values[name])
    return Outcome(**values)
