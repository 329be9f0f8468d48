"""Tasks by name. To add one, add a module here that defines ``TASK``: it is found by itself.

A module may also define ``make_task``, with a default for every parameter: these can then be set with the name, as in
``peg_in_hole:clearance=0.003``, wherever a task's name is taken.
"""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from inspect import signature
from pkgutil import iter_modules

from hdril.tasks.task import Task, Uniform, fixed


def _discover() -> tuple[dict[str, Task], dict[str, Callable[..., Task]]]:
    tasks: dict[str, Task] = {}
    builders: dict[str, Callable[..., Task]] = {}
    for found in iter_modules(__path__):
        module = import_module(f"{__name__}.{found.name}")
        task = getattr(module, "TASK", None)
        if task is None:
            continue
        if task.name in tasks:
            raise ValueError(f"two tasks are named {task.name!r}")
        tasks[task.name] = task
        if hasattr(module, "make_task"):
            builders[task.name] = module.make_task
    return tasks, builders


TASKS, _BUILDERS = _discover()
"""Tasks by name, with the defaults of their parameters."""


def base_name(name: str) -> str:
    """A task's name without parameters."""
    return name.partition(":")[0]


def task_parameters(name: str) -> dict[str, float]:
    """The parameters of a task: those that ``name`` gives, and the defaults of the others.

    Raises:
        ValueError: unknown name or parameter, or a value that is not a number; lists the valid ones.
    """
    base, _, settings = name.partition(":")
    if base not in TASKS:
        raise ValueError(f"unknown task {base!r}; choose from: {', '.join(TASKS)}")
    known = signature(_BUILDERS[base]).parameters if base in _BUILDERS else {}
    values = {parameter: float(entry.default) for parameter, entry in known.items()}
    for setting in settings.split(",") if settings else ():
        parameter, _, text = setting.partition("=")
        if parameter not in known:
            raise ValueError(f"{base} has no parameter {parameter!r}; it has: {', '.join(known) or 'none'}")
        try:
            values[parameter] = float(text)
        except ValueError:
            raise ValueError(f"{parameter} must be a number, got {text!r}") from None
    return values


def get_task(name: str) -> Task:
    """The task of that name, with its parameters if there are any: ``name`` or ``name:parameter=number,…``.

    Raises:
        ValueError: unknown name or parameter, or a value that is not a number or out of range; lists the valid ones.
    """
    values = task_parameters(name)
    base = base_name(name)
    return TASKS[base] if base == name.removesuffix(":") else replace(_BUILDERS[base](**values), name=name)


__all__ = ["TASKS", "Task", "Uniform", "base_name", "fixed", "get_task", "task_parameters"]
