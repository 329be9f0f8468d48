"""Fixtures of the commands' tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.commands import train


@pytest.fixture(scope="session")
def checkpoint(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """HDR-IL after two steps of stock ``lerobot-train``."""
    output = tmp_path_factory.mktemp("hdril") / "train"
    train(dataset, output, "--steps=2", "--save_freq=2")
    return output / "checkpoints" / "000002" / "pretrained_model"
