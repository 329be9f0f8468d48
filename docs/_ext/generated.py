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
    # After napoleon, which makes fields of sections.
    app.connect("autodoc-process-docstring", escape_bars, priority=900)
    return {"parallel_read_safe": True}
