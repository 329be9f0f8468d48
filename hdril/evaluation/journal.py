"""Outcomes of an evaluation that is not finished: kept as they come, so that the same evaluation can go on after a break."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hdril.errors import UserError
from hdril.evaluation.identity import Identity
from hdril.evaluation.score import Outcome
from hdril.evaluation.unfinished import UnfinishedFolder
from hdril.files import exclusively, write_atomically

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

    def _read(self) -> dict[int, Outcome]:
        files = [self.folder / _OUTCOMES, *sorted((self.folder / _SHARDS).glob(f"*/{_OUTCOMES}"))]
        return {outcome.seed: outcome for path in files for outcome in _read_outcomes(path)}

    @contextmanager
    def writing(self) -> Iterator[Callable[[Outcome], None]]:
        """Gives a function that adds an outcome, and reads :attr:`done` anew. Other processes are kept out until the end.

        If the evaluation fails before there is an outcome, nothing is left behind.

        Raises:
            BusyError: another process writes here.
            ValueError, FileExistsError: as for the class, if another process wrote here since.
        """
        # Files count, too: what another process played since must stay if it cannot be read.
        with self._unfinished.writing(
            begun=lambda: (self.folder / _SHARDS).exists() or bool(self.done or self._read())
        ):
            self.done = self._read()
            with self._appending(self.folder / _OUTCOMES) as add:
                yield add

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
            self.done = self._read()
            with self._appending(folder / _OUTCOMES) as add:
                yield add

    @contextmanager
    def _appending(self, path: Path) -> Iterator[Callable[[Outcome], None]]:
        """Gives a function that adds an outcome to a file of outcomes."""
        _drop_half_line(path)
        with path.open("a") as file:

            def add(outcome: Outcome) -> None:
                if not path.exists():
                    raise UserError(
                        f"{path.parent} was removed by another process, which finished the evaluation or gave it up"
                    )
                file.write(json.dumps(asdict(outcome)) + "\n")
                file.flush()
                self.done[outcome.seed] = outcome

            yield add

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
