"""Where generated files are kept, and how they are written so that two processes may do it at once."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from filelock import FileLock, Timeout

from hdril.errors import UserError

MAX_SEED = 2**31 - 1
"""Largest seed of an episode."""


_UMASK = os.umask(0)  # it can only be read by setting it
os.umask(_UMASK)


def cache_folder() -> Path:
    """Folder of what can be made again: ``hdril`` in ``$XDG_CACHE_HOME``, or in ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hdril"


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Let ``write`` fill a file that appears at ``path`` when it is whole. If ``write`` fails, nothing appears."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as file:
            write(file)
        os.chmod(temporary, 0o666 & ~_UMASK)  # mkstemp lets nobody else read it
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


class BusyError(UserError):
    """Another process works on the same files."""


def is_busy(folder: Path) -> bool:
    """Whether another process is in ``folder`` by :func:`exclusively`."""
    if not (folder / "lock").exists():
        return False
    lock = FileLock(folder / "lock", blocking=False)
    try:
        lock.acquire()
    except Timeout:
        return True
    lock.release()
    return False


@contextmanager
def exclusively(folder: Path, doing: str) -> Iterator[None]:
    """Keep other processes out of ``folder``, which is made if it is not there, by a lock file in it.

    The lock goes with the process, however that ends; the file may stay.

    Raises:
        BusyError: another process is in there. Says what it is ``doing``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / "lock", blocking=False)
    try:
        lock.acquire()
    except Timeout:
        raise BusyError(f"another process is {doing}; wait for it, or stop it") from None
    try:
        yield
    finally:
        lock.release()
