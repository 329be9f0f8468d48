"""Folders of results that are not finished: bound to what they are of, so that the same command can go on after a break."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hdril.evaluation.checkpoint import read_json
from hdril.evaluation.identity import require_same
from hdril.files import LOCK, BusyError, exclusively, is_scrap, write_atomically

_PATIENCE = 30.0
"""s that a share waits for others that begin at the same time."""
_REMEDY = "delete it or choose another output_dir"


class UnfinishedFolder:
    """The folder ``<output>.partial``, which :meth:`finish` renames to ``output``. Nothing is written before :meth:`writing` or
    :meth:`begin_share`.

    Args:
        output: where the results will be.
        kind: what they are, in one word.
        record: name of the file that says what they are of.
        identity: what they are of, as JSON has it.
        key: of the identity in the record; empty if the record is the identity.

    Raises:
        ValueError: the folder holds unfinished results of something else, or a damaged record; names what differs.
        FileExistsError: ``output`` exists, or the folder holds something that is not of this kind.
    """

    def __init__(self, output: Path, kind: str, record: str, identity: dict[str, Any], key: str = "") -> None:
        self.output, self.folder = output, output.with_name(output.name + ".partial")
        self._kind, self._record, self._identity, self._key = kind, record, identity, key
        self._check()

    def _check(self) -> None:
        if self.output.exists():
            raise FileExistsError(f"{self.output} exists; choose another output_dir or delete it")
        # Another process may write its record between the two looks: then the second one sees it.
        if not self._same() and self._holds_more_than(LOCK) and not self._same():
            raise FileExistsError(f"{self.folder} exists and is no {self._kind}; {_REMEDY}")

    def _same(self) -> bool:
        """Whether the folder holds results of the same; raises ValueError if they are of something else."""
        path = self.folder / self._record
        if not path.exists():
            return False
        try:
            record = read_json(path)
        except ValueError as error:
            raise ValueError(f"{error}; what is in {self.folder} is not known: {_REMEDY}") from None
        require_same(str(self.folder), record.get(self._key) if self._key else record, self._identity, _REMEDY)
        return True

    def _holds_more_than(self, *names: str) -> bool:
        """Whether there are other files and folders than these. What a kill left of a file that was being written counts
        as nothing."""
        there = [path.name for path in self.folder.iterdir()] if self.folder.exists() else []
        return any(name not in names and not is_scrap(name) for name in there)

    @contextmanager
    def writing(self, begun: Callable[[], bool] | None = None) -> Iterator[None]:
        """Keep other processes out until the end. If it fails before it has ``begun``, nothing is left behind.

        Args:
            begun: whether there is something to go on with; unless given, any file or folder beside the record.

        Raises:
            BusyError: another process writes here.
            ValueError, FileExistsError: as for the class, if another process wrote here since.
        """
        missing = [path for path in self.folder.parents if not path.exists()]
        # A process that is kept out must not remove what the other one writes: the cleaning is done under the lock.
        with exclusively(self.folder, f"evaluating into {self.output}"):
            with self._removed_unless(lambda: self._holds_more_than(LOCK), missing):  # refused: the lock was made here
                self._check()
            with self._removed_unless(begun or (lambda: self._holds_more_than(self._record, LOCK)), missing):
                self._write_record()
                yield

    def begin_share(self) -> None:
        """Make the folder ready for a part of the results, which other processes may make beside others.

        Raises:
            ValueError, FileExistsError: as for the class, if another process wrote here since.
            BusyError: another process holds the folder, and does not say what for.
        """
        until = time.monotonic() + _PATIENCE
        while True:
            self._check()
            if self._same():
                return
            try:
                with exclusively(self.folder, f"evaluating into {self.output}"):
                    self._check()
                    self._write_record()
            except BusyError:  # another share begins: it writes the same in a moment
                if time.monotonic() > until:
                    raise
                time.sleep(0.05)

    def _write_record(self) -> None:
        record = json.dumps({self._key: self._identity} if self._key else self._identity, indent=2)
        write_atomically(self.folder / self._record, lambda file: file.write(record.encode()))

    @contextmanager
    def _removed_unless(self, kept: Callable[[], bool], made: list[Path]) -> Iterator[None]:
        """Remove the folder, and those of ``made`` that are empty then, if what is done in this context fails."""
        try:
            yield
        except BaseException:
            if not kept():
                shutil.rmtree(self.folder, ignore_errors=True)
                for path in made:  # the innermost first
                    if path.exists() and not any(path.iterdir()):
                        path.rmdir()
            raise

    def finish(self, *scratch: str) -> None:
        """Rename the folder to the output, without ``scratch``, files or folders: all is written. Call it within :meth:`writing`,
        which keeps others out.

        Raises:
            OSError: a file, or a folder that is not empty, is at ``output`` by now; the folder stays.
        """
        self.folder.replace(self.output)
        # Afterwards: if the process were killed before the folder is renamed, what was played would be lost with these.
        scraps = [path.name for path in self.output.iterdir() if is_scrap(path.name)]
        for path in (self.output / name for name in (*scratch, *scraps, self._record, LOCK)):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)  # a share that is late may still write there
            else:
                path.unlink(missing_ok=True)
