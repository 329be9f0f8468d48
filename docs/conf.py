"""Configuration of the documentation: ``make docs``. Nothing is fetched."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

from hdril import __version__

project = "hdril"
author = "the hdril developers"
release = __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.apidoc",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "generated",
]
exclude_patterns = ["_ext"]
html_theme = "furo"
html_title = "hdril"

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
suppress_warnings = ["epub.unknown_project_files"]

# Pages of the modules, one a module, made from the docstrings at each build. git ignores them.
_ROOT = Path(__file__).parents[1]
apidoc_modules = [
    {"path": str(path), "destination": f"reference/api/{path.name}", "separate_modules": True, "no_headings": False}
    for path in (_ROOT / "hdril", _ROOT / "policies/lerobot_policy_hdril/src/lerobot_policy_hdril")
]
autodoc_default_options = {"members": True, "member-order": "bysource", "ignore-module-all": True}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_numpy_docstring = False
html_static_path: list[str] = []
