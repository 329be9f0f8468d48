"""Where generated files are kept, and how they are written so that two processes may do it at once."""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from filelock import FileLock, Timeout

from hdril.errors import UserError

MAX_SEED = 2**31 - 1
"""Largest seed of an episode."""
LOCK = "lock"
"""Name of the file by which :func:`exclusively` keeps a folder."""
_TEMPORARY = ".tmp"
_UMASK = os.umask(0)  # it can only be read by setting it
os.umask(_UMASK)


def cache_folder() -> Path:
    """Folder of what can be made again: ``hdril`` in ``$XDG_CACHE_HOME``, or in ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hdril"


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Let ``write`` fill a file that appears at ``path`` when it is whole. If ``write`` fails, nothing appears."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with naming(path):
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=_TEMPORARY)
        try:
            with os.fdopen(descriptor, "wb") as file:
                write(file)
            os.chmod(temporary, 0o666 & ~_UMASK)  # mkstemp lets nobody else read it
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise


def is_scrap(name: str) -> bool:
    """Whether a file of this name is what a process that was killed left of one that :func:`write_atomically` wrote."""
    return name.startswith(".") and name.endswith(_TEMPORARY)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let failures of the system in this context name ``path`` unless they name a file that somebody knows.

    A disk that is full does not say which file it had no room for.
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None and (error.filename is None or is_scrap(Path(error.filename).name)):
            error.filename, error.filename2 = str(path), None
        raise


def read_arrays(path: Path) -> dict[str, Any]:
    """The arrays of an ``.npz`` file, by name.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged.
    """
    data = path.read_bytes()
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return dict(arrays)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file makes zipfile and NumPy raise a dozen kinds, SyntaxError among them
        raise ValueError(f"{path} is damaged: {error or type(error).__name__}") from error


class BusyError(UserError):
    """Another process works on the same files."""


def is_busy(folder: Path) -> bool:
    """Whether another process is in ``folder`` by :func:`exclusively`."""
    if not (folder / LOCK).exists():
        return False
    lock = FileLock(folder / LOCK, blocking=False)
    try:
        lock.acquire()
    except Timeout:
        return True
    lock.release()
    return False


@contextmanager
def exclusively(folder: Path, doing: str) -> Iterator[None]:
    """Keep other processes out of ``folder``, which is made if it is not there, by the file :data:`LOCK` in it.

    The lock goes with the process, however that ends; the file may stay.

    Raises:
        BusyError: another process is in there. Says what it is ``doing``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, blocking=False)
    try:
        lock.acquire()
    except Timeout:
        raise BusyError(f"another process is {doing}; wait for it, or stop it") from None
    try:
        yield
    finally:
        lock.release()
