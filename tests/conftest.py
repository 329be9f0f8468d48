"""Fixtures that several files share."""

from __future__ import annotations

import os

os.environ["HF_HUB_OFFLINE"] = "1"
# Several test processes share two cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock

from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import Recipe
from hdril.demonstrations.record import record
from hdril.tasks import TASKS

POLICY_FOLDERS = {"policies", "viewer"}
"""Folders whose tests involve a policy."""
POLICY_FIXTURES = {"checkpoint", "runs"}
"""Fixtures that make a policy."""


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "portable: involves a policy, so it must hold on any processor; run with make test-portable"
    )


def pytest_report_header() -> str:
    names = ("ATEN_CPU_CAPABILITY", "OMP_NUM_THREADS")
    return ", ".join(f"{name}: {os.environ.get(name, 'unset')}" for name in names)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as portable what involves a policy; other tests carry the mark themselves."""
    for item in items:
        fixtures = set(getattr(item, "fixturenames", ()))
        if item.path.parent.name in POLICY_FOLDERS or fixtures & POLICY_FIXTURES:
            item.add_marker(pytest.mark.portable)


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


@pytest.fixture(scope="session")
def made_up() -> Callable[..., Episode]:
    """``made_up(seed, frames=12, success=True)``: an episode of table lift whose numbers depend on the seed alone."""

    def make(seed: int, frames: int = 12, success: bool = True, label: list[int] | None = None) -> Episode:
        rng = np.random.default_rng(seed)
        labels = np.array(label) if label else np.arange(frames) * 6 // frames
        return Episode(
            seed=seed,
            state=rng.normal(size=(frames, 16)).astype(np.float32),
            environment_state=rng.normal(size=(frames, 7)).astype(np.float32),
            action=rng.normal(size=(frames, 16)).astype(np.float32),
            label=labels,
            start=np.diff(labels, prepend=-1) != 0,
            reward=rng.uniform(size=frames).astype(np.float32),
            success=success,
            unmet="" if success else "table upright",
            scenario=TASKS["table_lift"].sample(seed).to_json(),
        )

    return make
