"""Markdown tables."""

from __future__ import annotations

from hdril.markdown import table


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split(" | ")]


def test_cells_are_shown_as_they_are() -> None:
    heads, rule, row = table(("name", "rate"), [("a", "0.10"), ("0003", 7)]).splitlines()[:3]
    assert cells(heads) == ["name", "rate"]
    assert set(rule) == {"|", "-"}
    assert cells(row) == ["a", "0.10"]
    assert cells(table(("name", "rate"), [("a", "0.10"), ("0003", 7)]).splitlines()[3]) == ["0003", "7"]


def test_a_bar_in_a_cell_does_not_end_it() -> None:
    assert cells(table(("a|b",), [("c|d",)]).splitlines()[0]) == [r"a\|b"]
    assert cells(table(("a|b",), [("c|d",)]).splitlines()[2]) == [r"c\|d"]


def test_a_table_may_be_empty() -> None:
    assert len(table(("a", "b"), []).splitlines()) == 2
