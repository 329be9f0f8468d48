"""Worker processes end with the process that started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress

PROGRAM = """
import time
from hdril.workers import worker_pool
with worker_pool(2) as pool:
    pool.submit(time.sleep, 600)
    pool.submit(print, "one worker sleeps, the other waits for work", flush=True).result()
    time.sleep(600)
"""


def test_workers_do_not_outlive_a_killed_parent() -> None:
    """Every process of the pool inherits standard output: it ends when the last of them is gone."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline().startswith("one worker sleeps")
        process.kill()
        process.communicate(timeout=60)
        assert process.returncode == -signal.SIGKILL
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
