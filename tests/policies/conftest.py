"""Fixtures of the policy's tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from tests.policies.tools import read, vary_lengths


@pytest.fixture(scope="session")
def metadata(dataset: Path) -> LeRobotDatasetMetadata:
    return read(dataset)


@pytest.fixture
def copy(dataset: Path, tmp_path: Path) -> Path:
    """A copy of the dataset, to be changed."""
    return Path(shutil.copytree(dataset, tmp_path / "copy"))


@pytest.fixture(scope="session")
def varied(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> LeRobotDatasetMetadata:
    """The dataset with primitives of varying length."""
    return read(vary_lengths(Path(shutil.copytree(dataset, tmp_path_factory.mktemp("varied") / "dataset"))))
