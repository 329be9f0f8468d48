"""Tasks by name. To add one: a file here that builds a :class:`~hdril.tasks.task.Task`, and its name in ``TASKS``."""

from hdril.tasks.table_lift import TABLE_LIFT
from hdril.tasks.task import Task, Uniform, fixed

TASKS: dict[str, Task] = {task.name: task for task in (TABLE_LIFT,)}


def get_task(name: str) -> Task:
    """The task of that name.

    Raises:
        ValueError: unknown name; lists the valid ones.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; choose from: {', '.join(TASKS)}")
    return TASKS[name]


__all__ = ["TASKS", "Task", "Uniform", "fixed", "get_task"]
