"""Steps that take no time: each writes a text made of its own and those of its inputs, and counts how often it was done."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hdril.benchmark.steps import Folders, Step

PROGRAM = """
import os, sys, time
from pathlib import Path
text, pause, count, output, *inputs = sys.argv[1:]
with Path(count).open("a") as file:
    file.write(text + "\\n")
parts = [text, *((Path(folder) / "text").read_text() for folder in inputs)]
output = Path(output)
output.mkdir(parents=True)
time.sleep(float(pause))
if text.startswith("broken"):
    sys.exit("this step cannot be done")
(output / "threads").write_text(os.environ["OMP_NUM_THREADS"] + os.environ["MKL_NUM_THREADS"])
(output / "text").write_text("(" + " ".join(parts) + ")")
"""


@dataclass(frozen=True)
class Words(Step):
    """Writes ``text`` and what its inputs wrote."""

    text: str
    count: Path
    """A file with a line for each time that a step was begun."""
    made_from: tuple[Words, ...] = ()
    pause: float = field(default=0.0, compare=False)
    """s between the beginning and the end; decides nothing."""

    resumes: bool = field(default=False, compare=False)

    kind = "words"

    @property
    def title(self) -> str:
        return self.text

    @property
    def inputs(self) -> Mapping[str, Step]:
        return {str(i): step for i, step in enumerate(self.made_from)}

    def settings(self) -> dict[str, Any]:
        edited = self.count.with_name("edited")  # stands for a config file, or a source
        return {"text": self.text, "edition": edited.read_text() if edited.exists() else ""}

    def command(self, output: Path, inputs: Folders) -> list[str]:
        return [sys.executable, "-c", PROGRAM, self.text, str(self.pause), str(self.count), str(output),
                *map(str, inputs.values())]  # fmt: skip

    def digest(self, output: Path) -> str:
        return (output / "text").read_text()
