"""Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tabulate import tabulate


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in GitHub's Markdown. Cells are shown as ``str`` shows them; a bar in a cell does not end the cell."""
    cells = [[str(cell).replace("|", r"\|") for cell in row] for row in rows]
    return tabulate(cells, [head.replace("|", r"\|") for head in heads], tablefmt="github", disable_numparse=True)
