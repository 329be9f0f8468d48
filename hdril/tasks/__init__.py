"""Tasks by name: those of this package, and those of other packages.

To add a task here, add a module that defines ``TASK``: it is found by itself. The module may also define ``make_task``, with
a default for every parameter. The parameters can then be set with the name, as in ``peg_in_hole:clearance=0.003``, wherever a
task's name is taken.

Another package adds a task with such a module of its own, and an entry point of the group ``hdril.tasks`` that names the
module. The name of the entry point must be the name of the task::

    [project.entry-points."hdril.tasks"]
    stack_cups = "my_package.stack_cups"
"""

from dataclasses import replace
from importlib import import_module
from inspect import signature
from pkgutil import iter_modules
from types import ModuleType

from hdril.plugins import Registry
from hdril.tasks.task import Task, Uniform, fixed


def _discover() -> dict[str, ModuleType]:
    """The modules here that define a task, by the task's name. An error in a module is raised, not skipped."""
    found: dict[str, ModuleType] = {}
    for info in iter_modules(__path__):
        module = import_module(f"{__name__}.{info.name}")
        task = getattr(module, "TASK", None)
        if task is None:
            continue
        if task.name in found:
            raise ValueError(f"two tasks are named {task.name!r}: {found[task.name].__name__} and {module.__name__}")
        found[task.name] = module
    return found


def _read(module: object) -> Task:
    task = getattr(module, "TASK", None)
    if not isinstance(task, Task):
        raise TypeError(f"{getattr(module, '__name__', module)} defines no TASK of type hdril.tasks.Task")
    return task


TASKS: Registry[Task] = Registry("task", "hdril.tasks", _discover(), _read)
"""Tasks by name, with the defaults of their parameters."""


def base_name(name: str) -> str:
    """A task's name without parameters."""
    return name.partition(":")[0]


def task_parameters(name: str) -> dict[str, float]:
    """The parameters of a task: those that ``name`` gives, and the defaults of the others.

    Raises:
        ValueError: unknown name or parameter, or a value that is not a number; lists the valid ones. Also if the task is from
            another package and cannot be imported (:class:`~hdril.plugins.PluginError`).
    """
    base, _, settings = name.partition(":")
    TASKS.find(base)
    build = getattr(TASKS.source(base), "make_task", None)
    known = signature(build).parameters if build else {}
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
        ValueError: as :func:`task_parameters`, or a value that is out of range.
    """
    values, (base, _, settings) = task_parameters(name), name.partition(":")
    return replace(TASKS.source(base).make_task(**values), name=name) if settings else TASKS[base]


__all__ = ["TASKS", "Task", "Uniform", "base_name", "fixed", "get_task", "task_parameters"]
