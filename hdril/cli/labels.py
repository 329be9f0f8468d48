"""hdril-labels: labels of primitives from one of LeRobot's forms to the other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hdril.cli.common import run
from hdril.demonstrations.labels import check_forms, convert
from hdril.demonstrations.read import read_primitives


@dataclass
class LabelsConfig:
    """Copy a LeRobot dataset and add labels of primitives in the other form: hdril-labels DATASET, then options.

    subtask_index gives each frame a number that meta/subtasks.parquet names; Rerun shows it. language is the column
    language_persistent, with rows of the style subtask; LeRobot's annotation tool writes it, and drops subtask_index.
    """

    dataset: Path
    """Folder of the dataset; --dataset= may be left out."""
    to: str
    """The form to add: subtask_index or language."""
    output: Path
    """Folder of the copy; must not exist."""


def labels_command(config: LabelsConfig) -> None:
    """Convert."""
    (form,) = check_forms(config.to) if "," not in config.to else ("",)
    if not form:
        raise ValueError(f"to must be one form, got {config.to!r}")
    convert(config.dataset, form, config.output)
    names = ", ".join(read_primitives(config.output))  # a word that was mistyped is seen
    print(f"{config.output} has labels in {form}, too: {names}")


def main() -> None:
    """Entry point."""
    run("hdril-labels", LabelsConfig, labels_command, positional="dataset")


if __name__ == "__main__":
    main()
