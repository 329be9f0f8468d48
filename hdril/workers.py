"""Worker processes: as many as asked for, and none that outlives the process that started them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from threading import Thread

from hdril.errors import UserError


@contextmanager
def worker_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of ``workers`` processes. They end with the block, or with this process, however that ends.

    Raises:
        UserError: a worker process was killed.
    """
    # Workers that are forked from this process would inherit its threads' locks.
    pool = ProcessPoolExecutor(workers, get_context("forkserver"), initializer=_end_with_parent)
    try:
        yield pool
    except BrokenProcessPool as error:
        cause = "it" if workers == 1 else f"{workers} workers"
        remedy = "" if workers == 1 else ": try fewer"
        raise UserError(f"a worker process was killed; {cause} may need more memory than there is{remedy}") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _end_with_parent() -> None:
    """Watch the parent of this worker process from a thread.

    A worker that waits for work does not notice that its parent is gone: its siblings hold the other end of the queue, too.
    """
    Thread(target=_wait_for_parent, name="end with parent", daemon=True).start()


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # sys.exit would end this thread alone
