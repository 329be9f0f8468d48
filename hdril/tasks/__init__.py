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
from hdril.tasks.task import Task, Uniform, Variation, fixed


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
    _check_builder(getattr(module, "__name__", module), getattr(module, "make_task", None))
    return task


def _check_builder(module: object, build: object) -> None:
    """Raises TypeError unless ``make_task``, if there is one, can be called with numbers by name."""
    if build is None:
        return
    if not callable(build):
        raise TypeError(f"{module} has a make_task that is no function")
    for name, entry in signature(build).parameters.items():
        if not isinstance(entry.default, int | float):
            raise TypeError(f"{module} has a make_task whose parameter {name!r} has no number as its default")


TASKS: Registry[Task] = Registry("task", "hdril.tasks", _discover(), _read)
"""Tasks by name, with the defaults of their parameters."""


def base_name(name: str) -> str:
    """A task's name without parameters."""
    return name.partition(":")[0]


NOMINAL_LEVEL, VARIED, HARD = "nominal", "varied", "hard"
LEVELS = (NOMINAL_LEVEL, VARIED, HARD)
"""``nominal``: only placements vary. ``varied``: every factor. ``hard``: every factor, and one event in each episode."""
ANY_EVENT, DETAILED = "any_event", "detailed"


def _builder(base: str) -> dict[str, float]:
    """The parameters of a task's ``make_task``, with their defaults."""
    build = getattr(TASKS.source(base), "make_task", None)
    return {name: float(entry.default) for name, entry in signature(build).parameters.items()} if build else {}


def _at_level(task: Task, level: str) -> dict[str, float]:
    varied = level in (VARIED, HARD)
    return {
        **{factor.name: factor.span if varied else factor.off for factor in task.all_factors},
        **dict.fromkeys((spec.name for spec in task.events), 0.0),
        ANY_EVENT: float(level == HARD and bool(task.events)),
    }


def task_parameters(name: str) -> dict[str, float]:
    """The parameters of a task: those that ``name`` gives, and the defaults of the others.

    They are the parameters of its ``make_task``, the ranges of its factors, the probabilities of its events, and
    ``detailed``: 1 if all is observed that may vary (the default as soon as something does), 0 if it is observed as in the
    nominal task. ``level=…`` sets all ranges and probabilities at once.

    Raises:
        ValueError: unknown name, level or parameter, or a value that is not a number or out of range; lists the valid ones.
            Also if the task is from another package and cannot be imported (:class:`~hdril.plugins.PluginError`).
    """
    base, _, settings = name.partition(":")
    task, given = TASKS.find(base), _settings(settings)
    level = given.pop("level", NOMINAL_LEVEL)
    if level not in LEVELS:
        raise ValueError(f"unknown level {level!r}; choose from: {', '.join(LEVELS)}")
    variable = _at_level(task, level)
    values = _builder(base) | variable
    for parameter, text in given.items():
        if parameter not in (*values, DETAILED):
            raise ValueError(f"{base} has no parameter {parameter!r}; it has: level, {', '.join((*values, DETAILED))}")
        try:
            values[parameter] = float(text)
        except ValueError:
            raise ValueError(f"{parameter} must be a number, got {text!r}") from None
    nominal = _at_level(task, NOMINAL_LEVEL)
    values.setdefault(DETAILED, float(any(values[key] != nominal[key] for key in nominal)))
    for factor in task.all_factors:
        factor.check(values[factor.name])
    for probability in (*(spec.name for spec in task.events), ANY_EVENT):
        if not 0.0 <= values[probability] <= 1.0:
            raise ValueError(f"{probability} must be from 0 to 1, got {values[probability]:g}")
    if values[DETAILED] not in (0.0, 1.0):
        raise ValueError(f"{DETAILED} must be 0 or 1, got {values[DETAILED]:g}")
    return values


def _settings(text: str) -> dict[str, str]:
    """The texts by parameter.

    Raises:
        ValueError: a parameter is given twice.
    """
    items = [item.partition("=") for item in text.split(",") if item]
    names = [key for key, _, _ in items]
    if twice := [key for key in names if names.count(key) > 1]:
        raise ValueError(f"{twice[0]} is given twice in {text!r}")
    return {key: value for key, _, value in items}


def built_as(name: str) -> tuple[str, dict[str, float]]:
    """A task's name without parameters, and the parameters of its ``make_task``: what scenes of one task have in common.

    Raises:
        ValueError: as :func:`task_parameters`.
    """
    values, base = task_parameters(name), base_name(name)
    return base, {parameter: values[parameter] for parameter in _builder(base)}


def get_task(name: str) -> Task:
    """The task of that name, with its parameters if there are any: ``name`` or ``name:parameter=number,…``.

    Raises:
        ValueError: as :func:`task_parameters`, or a value that is out of range.
    """
    values, (base, _, settings) = task_parameters(name), name.partition(":")
    if not settings:
        return TASKS[base]
    _, build = built_as(name)
    task = TASKS.source(base).make_task(**build) if build else TASKS[base]
    variation = Variation(
        {factor.name: values[factor.name] for factor in task.all_factors if values[factor.name] != factor.off},
        {spec.name: values[spec.name] for spec in task.events if values[spec.name]},
        values[ANY_EVENT],
    )
    return replace(task, name=name, variation=variation, detailed=bool(values[DETAILED]))


__all__ = ["LEVELS", "TASKS", "Task", "Uniform", "base_name", "built_as", "fixed", "get_task", "task_parameters"]
