"""Directives whose content comes from the code at each build: options of commands, files of the package."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib import import_module

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from hdril.markdown import table
from hdril.tasks import TASKS
from hdril.tasks.events import EVENT_KINDS, EventSpec
from hdril.tasks.factors import COMMON


def help_of(module: str) -> str:
    """What ``--help`` of a command prints.

    Raises:
        subprocess.CalledProcessError: the command fails.
    """
    environment = os.environ | {"COLUMNS": "100", "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(
        [sys.executable, "-m", module, "--help"], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


class CommandHelp(SphinxDirective):
    """``{command-help} hdril.cli.record``: the help of the command that this module is."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        module = self.arguments[0]
        self.env.note_dependency(str(import_module(module).__file__))
        text = help_of(module)
        return [nodes.literal_block(text, text, language="text")]


class ModuleText(SphinxDirective):
    """``{module-text} hdril.evaluation.report``: the docstring of a module, as text."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        module = import_module(self.arguments[0])
        self.env.note_dependency(str(module.__file__))
        return self.parse_text_to_nodes(module.__doc__ or "")


class TaskVariation(SphinxDirective):
    """``{task-variation} table_lift``: what varies in a task, and what may happen to it, as tables.

    ``{task-variation} all``: the factors that every task has.
    """

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        name = self.arguments[0]
        factors = COMMON if name == "all" else TASKS[name].factors
        rows = [
            [f"`{f.name}`", f.kind, f"{f.span:g} {f.unit}", f"{f.limit:g} {f.unit}", f.meaning, ", ".join(f.parts)]
            for f in factors
        ]
        text = table(["factor", "kind", "range", "at most", "what varies", "each for"], rows)
        if name != "all":
            text += "\n\n" + table(
                ["event", "kind", "begins at frame", "takes", "happens to", "strength"], map(_event, TASKS[name].events)
            )
        return self.parse_text_to_nodes(text)


def _event(spec: EventSpec) -> list[str]:
    unit = EVENT_KINDS[spec.kind].unit
    strength = f"{spec.strength[0]:g} to {spec.strength[1]:g} {unit}" if spec.strength else ""
    frames = "" if spec.frames == (1, 1) else "{} to {} frames".format(*spec.frames)
    return [f"`{spec.name}`", spec.kind, "{} to {}".format(*spec.window), frames, ", ".join(spec.targets), strength]


def escape_bars(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Norms in equations, |x|, are no substitutions of reStructuredText: escape bars that are not in literals."""
    for number, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [re.sub(r"(?<!\\)\|", r"\\|", part) for part in parts[::2]]
        lines[number] = "``".join(parts)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("command-help", CommandHelp)
    app.add_directive("module-text", ModuleText)
    app.add_directive("task-variation", TaskVariation)
    # After napoleon, which makes fields of sections.
    app.connect("autodoc-process-docstring", escape_bars, priority=900)
    return {"parallel_read_safe": True}
