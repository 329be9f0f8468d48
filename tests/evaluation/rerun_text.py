"""Recordings as text, for tests."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from rerun.experimental import RrdReader


def read_back(path: Path) -> str:
    """Verify a recording and print all of it."""
    rerun = Path(sys.executable).with_name("rerun")
    subprocess.run([rerun, "rrd", "verify", str(path)], check=True, capture_output=True)
    return subprocess.run([rerun, "rrd", "print", "-vvv", str(path)], check=True, capture_output=True, text=True).stdout


def states(text: str, lane: str) -> set[str]:
    """States that a lane of a recording takes on. Their colours are in a chunk of their own, which is left out."""
    chunks = [chunk for chunk in text.split("entity_path: ")[1:] if chunk.startswith(f"{lane} ")]
    changes = [chunk for chunk in chunks if "StateChange:state" in chunk]
    return set(re.findall(r"\[(\w+)\]", " ".join(changes)))


def value_of(path: Path, entity: str, component: str) -> str:
    """The first value of a component of an entity, whole: printed recordings cut long texts."""
    return values_of(path, entity, component)[0]


def values_of(path: Path, entity: str, component: str) -> list[Any]:
    """The values of a component of an entity, chunk by chunk, one a row."""
    found: list[Any] = []
    for chunk in RrdReader(path).store().stream().to_chunks():
        columns = chunk.to_record_batch().to_pydict()
        if str(chunk.entity_path) == entity and component in columns:
            found += [row[0] for row in columns[component]]
    assert found, f"{path} has no {component} of {entity}"
    return found
