"""Recordings as text, for tests."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

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
    for chunk in RrdReader(path).store().stream().to_chunks():
        columns = chunk.to_record_batch().to_pydict()
        if str(chunk.entity_path) == entity and component in columns:
            return columns[component][0][0]
    raise AssertionError(f"{path} has no {component} of {entity}")
