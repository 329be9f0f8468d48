"""A suite that is not finished: the folder of its cells, in which the same suite can go on after a break."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hdril.evaluation.checkpoint import read_json
from hdril.evaluation.identity import require_same
from hdril.files import exclusively, write_atomically

_RUN, _LOCK = "suite_run.json", "lock"
_REMEDY = "delete it or choose another output_dir"


class SuiteFolder:
    """The folder ``<output>.partial``, which :meth:`finish` renames to ``output``. Each cell has a folder in it.

    Cells guard themselves (:class:`hdril.evaluation.journal.Journal`); the folder makes sure that they are cells of one suite.

    Raises:
        ValueError: the folder holds an unfinished suite of something else; names what differs.
        FileExistsError: ``output`` exists, or the folder holds something that is no suite.
    """

    def __init__(self, output: Path, identity: dict[str, Any]) -> None:
        self.output, self.folder = output, output.with_name(output.name + ".partial")
        self._identity = identity
        self._check()

    def _check(self) -> None:
        if self.output.exists():
            raise FileExistsError(f"{self.output} exists; choose another output_dir or delete it")
        if (self.folder / _RUN).exists():
            require_same(str(self.folder), read_json(self.folder / _RUN), self._identity, _REMEDY)
        elif self.folder.exists() and any(path.name != _LOCK for path in self.folder.iterdir()):
            raise FileExistsError(f"{self.folder} exists and is no suite; {_REMEDY}")

    def cell(self, name: str) -> Path:
        """Where the evaluation of a cell is, or will be."""
        return self.folder / name

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Keep other processes out. If the suite fails before there is an outcome, nothing is left behind.

        Raises:
            BusyError: another process writes here.
            ValueError, FileExistsError: as for the class, if another process wrote here since.
        """
        missing = [path for path in self.folder.parents if not path.exists()]
        with exclusively(self.folder, f"evaluating into {self.output}"):
            try:
                self._check()
                run = json.dumps(self._identity, indent=2)
                write_atomically(self.folder / _RUN, lambda file: file.write(run.encode()))
                yield
            except BaseException:
                self._remove_unless_begun(missing)
                raise

    def _remove_unless_begun(self, made: list[Path]) -> None:
        if {path.name for path in self.folder.iterdir()} - {_RUN, _LOCK}:
            return
        shutil.rmtree(self.folder, ignore_errors=True)
        for path in made:  # the innermost first
            if path.exists() and not any(path.iterdir()):
                path.rmdir()

    def finish(self) -> None:
        """Rename the folder to the output: all is written. Call it within :meth:`writing`."""
        for name in (_RUN, _LOCK):
            (self.folder / name).unlink(missing_ok=True)
        self.folder.replace(self.output)
