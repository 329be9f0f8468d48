"""Suites: the cells in which a policy is tried, from the nominal task to the hard one.

A cell is an ordinary evaluation of a task with parameters, on the same seeds as all others. Cells with events have a control:
the same scenes, in which nothing happens, with the same budget of frames. Event and control of a seed are the same to the
last bit until the event, so the difference of their outcomes is what the event did.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from hdril.tasks import ANY_EVENT, DETAILED, HARD, VARIED, Task, get_task

Kind = Literal["nominal", "factor", "varied", "event", "hard", "control"]
NOMINAL, CONTROL, VARIED_CONTROL = "nominal", "control", "varied_control"


@dataclass(frozen=True)
class Cell:
    """A row of the table, or a control."""

    name: str
    """Of the row, and of the folder."""
    kind: Kind
    task: str
    """The task with its parameters."""
    control: str = ""
    """The cell with the same scenes, in which nothing happens; empty if nothing happens in this one."""
    max_frames: int | None = None
    """Frames after which an episode is cut; the task's budget unless given."""


def factor_cells(task: str, detailed: bool) -> tuple[Cell, ...]:
    """Nominal, each factor alone, all factors, each event alone, and all factors with an event; then the controls.

    Args:
        task: its name, with parameters of the task itself if there are any.
        detailed: whether all that may vary is observed.
    """
    spec = get_task(task)

    def at(setting: str = "") -> str:
        """The task with a setting. What is observed is the same in all cells."""
        shown = f"{DETAILED}={int(detailed)}" if setting or detailed else ""
        settings = ",".join(part for part in (setting, shown) if part)
        return f"{task}{',' if ':' in task else ':'}{settings}" if settings else task

    def control(name: str, scenes: str, disturbed: str) -> Cell:
        return Cell(name, "control", scenes, max_frames=get_task(disturbed).budget)

    undisturbed = (
        Cell(NOMINAL, "nominal", at()),
        *(Cell(factor.name, "factor", at(f"{factor.name}={factor.span:g}")) for factor in spec.all_factors),
        Cell(VARIED, "varied", at(f"level={VARIED}")),
    )
    if not spec.events:
        return undisturbed
    events = [Cell(event.name, "event", at(f"{event.name}=1"), CONTROL) for event in spec.events]
    hard = Cell(HARD, "hard", at(f"level={HARD}"), VARIED_CONTROL)
    controls = (
        control(CONTROL, at(), events[0].task),
        control(VARIED_CONTROL, at(f"level={VARIED}"), hard.task),
    )
    return (*undisturbed, *events, hard, *controls)


SUITES: dict[str, Callable[[str, bool], tuple[Cell, ...]]] = {"factors": factor_cells}
"""Makers of cells by the suite's name."""


def check_suite(suite: str, task: str) -> None:
    """Raises ValueError unless there is such a suite, and the task, which sets none of what the suite sets, has cells in it."""
    if suite not in SUITES:
        raise ValueError(f"unknown suite {suite!r}; choose from: {', '.join(SUITES)}")
    spec = get_task(task)
    if not spec.factors and not spec.events:
        raise ValueError(f"{spec.name} declares neither factors nor events: there is nothing to try it with")
    if taken := [name for name in _settings(task) if name in _of_the_suite(spec)]:
        raise ValueError(f"the suite {suite} sets {', '.join(taken)} itself: give the task without")


def _settings(task: str) -> list[str]:
    return [setting.partition("=")[0] for setting in task.partition(":")[2].split(",") if setting]


def _of_the_suite(task: Task) -> set[str]:
    names = {entry.name for entry in (*task.all_factors, *task.events)}
    return names | {"level", ANY_EVENT, DETAILED}


def choose(cells: Sequence[Cell], names: Sequence[str]) -> tuple[Cell, ...]:
    """The cells of these names, in their own order, with those that they are compared with; all if there are no names.

    Raises:
        ValueError: there is no such cell; lists the valid names.
    """
    rows = [cell.name for cell in cells if cell.kind != "control"]
    if unknown := [name for name in names if name not in rows]:
        raise ValueError(f"unknown cell {unknown[0]!r}; choose from: {', '.join(rows)}")
    if not names:
        return tuple(cells)
    wanted = {NOMINAL, *names} | {cell.control for cell in cells if cell.name in names}
    return tuple(cell for cell in cells if cell.name in wanted)
