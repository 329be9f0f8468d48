"""Which package knows which: the imports, the picture of them, and what must be in one place."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
POLICY = ROOT / "policies/lerobot_policy_hdril/src/lerobot_policy_hdril"

sys.path.insert(0, str(ROOT / "docs"))
import architecture  # noqa: E402 (it lies in docs, which is no package)


def test_imports_point_down() -> None:
    floor = {name: number for number, names in enumerate(architecture.FLOORS) for name in names}
    pairs = architecture.arrows()
    assert {name for pair in pairs for name in pair} == set(floor)
    assert {(a, b) for a, b in pairs if floor[a] >= floor[b]} == set()


def test_small_modules_import_no_package() -> None:
    for name in set(architecture.LEFT_OUT) - {"__init__"}:
        text = (ROOT / "hdril" / f"{name}.py").read_text()
        imported = set(re.findall(r"^\s*(?:from|import) hdril\.(\w+)", text, re.MULTILINE))
        assert imported <= set(architecture.LEFT_OUT), name


def test_the_picture_is_of_the_imports() -> None:
    drawn = architecture.PICTURE.read_text()
    assert drawn == architecture.draw(architecture.arrows()), "run: python docs/architecture.py"


def test_an_import_shows_as_an_arrow_or_follows_from_arrows(tmp_path: Path) -> None:
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks/a.py").write_text("def late():\n    from hdril.simulation.world import World\n")
    (tmp_path / "env.py").write_text(
        "import hdril.tasks.a\nfrom hdril.simulation import world\nfrom hdril import geometry\n"
    )
    pairs = architecture.arrows(tmp_path)
    assert pairs == {("tasks", "simulation"), ("env", "tasks"), ("env", "simulation")}
    assert architecture.reduce(pairs) == {("tasks", "simulation"), ("env", "tasks")}


def _importers(package: str, folder: Path) -> set[str]:
    pattern = re.compile(rf"^\s*(?:from|import) {package}\b", re.MULTILINE)
    return {str(file.relative_to(folder)) for file in folder.rglob("*.py") if pattern.search(file.read_text())}


def test_one_module_imports_pybullet() -> None:
    assert _importers("pybullet", ROOT / "hdril") == {"simulation/world.py"}


@pytest.mark.parametrize("package", ["hdril", "pybullet"])
def test_the_policy_does_not_know_the_simulator(package: str) -> None:
    assert _importers(package, POLICY) == set()
