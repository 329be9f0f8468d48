"""Fixtures that several files share."""

from __future__ import annotations

import os

os.environ["HF_HUB_OFFLINE"] = "1"
# Several test processes share two cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from pathlib import Path

import pytest
from filelock import FileLock

from hdril.demonstrations.provenance import Recipe
from hdril.demonstrations.record import record


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six recorded episodes of table lift, seeds 0 to 5; made once for all test processes.

    Mutation tests start thousands of processes and name a folder for all of them.
    """
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    root = Path(os.environ.get("HDRIL_TEST_DATASET", shared / "table_lift_6"))
    with FileLock(str(root) + ".lock"):
        if not root.exists():
            record(Recipe("table_lift"), 6, 0, root)
    return root
