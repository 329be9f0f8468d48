"""Results of steps on disk, found by what they are made from."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hdril
from hdril.benchmark.steps import Step
from hdril.digest import SHORT, digest_json
from hdril.evaluation.checkpoint import read_json
from hdril.files import write_atomically

RESULT, DONE, LOG = "result", "step.json", "log.txt"


@dataclass(frozen=True)
class Done:
    """A step that is done: where its result is, what that is, and how long it took."""

    output: Path
    digest: str
    seconds: float
    command: str
    machine: str = ""
    """What did it."""
    commit: str = ""
    """Of the checkout that it was done from, with a + if files were edited; empty if there is none."""


class Store:
    """A folder of results: ``<kind>/<digest of settings and inputs>/result``, and beside it ``step.json``, which is there when
    the result is whole.

    A step is asked for by what decides its result, and so is done anew when any of that has changed, and only then. Folders may
    be deleted: what is missing is made again.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self._done: dict[Step, Done] = {}
        self._settings: dict[Step, dict[str, Any]] = {}
        self._recipes: dict[Step, str] = {}

    def find(self, step: Step) -> Done | None:
        """What is known of a step that is done; None if it is not."""
        if step not in self._done:
            place = self.place(step)
            if place is None or not is_done(place):
                return None
            told = read_json(place / DONE)
            self._done[step] = Done(
                place / RESULT,
                told["digest"],
                told["seconds"],
                told["command"],
                told["machine"],
                told.get("commit", ""),
            )
        return self._done[step]

    def place(self, step: Step) -> Path | None:
        """The folder of a step; None as long as an input is not done, because the result depends on what that is."""
        made_from = self.made_from(step)
        return None if made_from is None else self.folder / step.kind / digest_json(made_from)[: 2 * SHORT]

    def made_from(self, step: Step) -> dict[str, Any] | None:
        """All that decides the result of a step, as JSON; None as long as an input is not done."""
        inputs = {name: self.find(other) for name, other in step.inputs.items()}
        digests = {name: done.digest for name, done in inputs.items() if done is not None}
        return {"settings": self.settings(step), "inputs": digests} if len(digests) == len(inputs) else None

    def settings(self, step: Step) -> dict[str, Any]:
        """:meth:`Step.settings`, worked out once."""
        if step not in self._settings:
            self._settings[step] = step.settings()
        return self._settings[step]

    def recipe(self, step: Step) -> str:
        """Digest of how a step is made: its settings, and the recipes of its inputs. Known before anything is done, and the same
        on every machine, while the digests of results are not."""
        if step not in self._recipes:
            inputs = {name: self.recipe(other) for name, other in step.inputs.items()}
            self._recipes[step] = digest_json([step.kind, self.settings(step), inputs])[: 2 * SHORT]
        return self._recipes[step]

    def input_folders(self, step: Step) -> dict[str, Path]:
        """Where the results of a step's inputs are.

        Raises:
            KeyError: an input is not done.
        """
        return {name: self.get(other).output for name, other in step.inputs.items()}

    def get(self, step: Step) -> Done:
        """What is known of a step that is done.

        Raises:
            KeyError: it is not.
        """
        done = self.find(step)
        if done is None:
            raise KeyError(step.title)
        return done

    def relative(self, command: str) -> str:
        """A command line with the folder of the store named in words, so that it means something elsewhere."""
        return command.replace(f"{self.folder}/", "STORE/")


def is_done(place: Path) -> bool:
    """Whether the result of a step is there, and whole."""
    return (place / DONE).exists() and (place / RESULT).exists()


def mark_done(
    place: Path, step: Step, made_from: Mapping[str, Any], command: str, seconds: float, commit: str = ""
) -> None:
    """Say that the result of a step is whole.

    Raises:
        OSError, ValueError: it is not.
    """
    told = {"title": step.title, "digest": step.digest(place / RESULT), "seconds": round(seconds, 1),
            "command": command, "machine": _machine(), "commit": commit, "made_from": made_from}  # fmt: skip
    write_atomically(place / DONE, lambda file: file.write(json.dumps(told, indent=1).encode()))


def _machine() -> str:
    """The kind of this machine, without its name."""
    return f"{platform.machine()}, {platform.system()}, {os.cpu_count()} cores, {_processor()}"


def _processor() -> str:
    """The model of the processor, as far as it is told."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "unknown"


def checkout_commit() -> str:
    """See :attr:`Done.commit`. Empty if hdril is not in a checkout of its own repository."""
    package = Path(hdril.__file__).parent
    try:
        _git(package, "ls-files", "--error-unmatch", "__init__.py")
        edited = _git(package, "status", "--porcelain", "--", ":/hdril", ":/policies", ":/configs")
        return _git(package, "rev-parse", "--short", "HEAD") + ("+" if edited else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(folder: Path, *command: str) -> str:
    return subprocess.run(
        ["git", "-C", str(folder), *command], capture_output=True, text=True, check=True
    ).stdout.strip()
