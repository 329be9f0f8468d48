"""Digests: content told apart by a short text."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

SHORT = 12
"""Digits of a digest that people are shown."""


def digest_json(value: Any) -> str:
    """SHA-256, in hexadecimal, of canonical JSON: sorted keys, no spaces."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def digest_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_files(files: Iterable[Path]) -> str:
    """SHA-256 of names and contents of files, in the order given."""
    lines = "".join(f"{digest_file(file)} {file.name}\n" for file in files)
    return hashlib.sha256(lines.encode()).hexdigest()
