"""Tasks by name. To add one, add a module here that defines ``TASK``: it is found by itself."""

from importlib import import_module
from pkgutil import iter_modules

from hdril.tasks.task import Task, Uniform, fixed


def _discover() -> dict[str, Task]:
    tasks: dict[str, Task] = {}
    for module in iter_modules(__path__):
        task = getattr(import_module(f"{__name__}.{module.name}"), "TASK", None)
        if task is None:
            continue
        if task.name in tasks:
            raise ValueError(f"two tasks are named {task.name!r}")
        tasks[task.name] = task
    return tasks


TASKS: dict[str, Task] = _discover()


def get_task(name: str) -> Task:
    """The task of that name.

    Raises:
        ValueError: unknown name; lists the valid ones.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; choose from: {', '.join(TASKS)}")
    return TASKS[name]


__all__ = ["TASKS", "Task", "Uniform", "fixed", "get_task"]
