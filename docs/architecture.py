"""The picture of the packages of hdril and their imports: docs/images/architecture.svg.

python docs/architecture.py
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs/images/architecture.svg"

FLOORS = (
    ("aloha",),
    ("cli", "lerobot_env"),
    ("benchmark", "hub", "viewer"),
    ("evaluation",),
    ("demonstrations",),
    ("rollout",),
    ("env",),
    ("tasks",),
    ("simulation",),
)
"""Packages from the top down: none imports one above it or beside it."""
PARTS = {"trace": "rollout"}
"""Modules that are drawn as part of another."""
LEFT_OUT = ("actor", "digest", "errors", "execution", "files", "geometry", "markdown", "plugins", "workers", "__init__")
"""Small modules that any package may use; they import no package."""
POLICY = "lerobot_policy_hdril"
MEETINGS = {"evaluation": "LeRobot, explain()", "demonstrations": "the dataset's schema"}
"""Where the policy, which imports nothing of hdril, meets hdril, and through what."""

WIDTH, HEIGHT, BOX, TOP = 760, 70, (150, 36), 20


def module_package(parts: tuple[str, ...]) -> str:
    """The package that a module of hdril is drawn as, given its path below hdril."""
    return PARTS.get(parts[0], parts[0])


def _imports(file: Path) -> Iterator[str]:
    """The modules of hdril that a file imports, without ``hdril.``, those in functions included."""
    for node in ast.walk(ast.parse(file.read_text())):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"hdril.{a.name}" for a in node.names] if node.module == "hdril" else [node.module]
        yield from (name.removeprefix("hdril.") for name in names if name.startswith("hdril."))


def arrows(package: Path = ROOT / "hdril") -> set[tuple[str, str]]:
    """Pairs (importer, imported) of the packages that are drawn."""
    found = set()
    for file in package.rglob("*.py"):
        importer = module_package(file.relative_to(package).with_suffix("").parts)
        for name in _imports(file):
            imported = module_package(tuple(name.split(".")))
            if imported != importer and not {importer, imported} & set(LEFT_OUT) and not imported.startswith("__"):
                found.add((importer, imported))
    return found


def reduce(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The pairs that no chain of others implies: what the picture shows."""

    def reaches(start: str, end: str, without: tuple[str, str]) -> bool:
        return any(b == end or reaches(b, end, without) for a, b in pairs if a == start and (a, b) != without)

    return {pair for pair in pairs if not reaches(*pair, without=pair)}


def _places() -> dict[str, tuple[float, float]]:
    """Centre of each box, pixels."""
    column = {1: (250.0,), 2: (150.0, 350.0), 3: (85.0, 250.0, 415.0)}
    places = {
        name: (x, TOP + BOX[1] / 2 + row * HEIGHT)
        for row, floor in enumerate(FLOORS)
        for name, x in zip(floor, column[len(floor)], strict=True)
    }
    y = sum(places[name][1] for name in MEETINGS) / len(MEETINGS)
    return places | {POLICY: (WIDTH - 20 - BOX[0] / 2, y)}


def _arrow(start: tuple[float, float], end: tuple[float, float]) -> str:
    """From the lower edge of a box to the upper edge of one below."""
    return f"M{start[0]:.0f},{start[1] + BOX[1] / 2:.0f} L{end[0]:.0f},{end[1] - BOX[1] / 2 - 3:.0f}"


def _meeting(place: tuple[float, float], policy: tuple[float, float], words: str) -> str:
    """A dashed line between a box and the policy's, with words on it."""
    x0, x1 = place[0] + BOX[0] / 2, policy[0] - BOX[0] / 2
    above = -8 if place[1] < policy[1] else 18
    return (
        f'<path d="M{x0:.0f},{place[1]:.0f} L{x1:.0f},{policy[1]:.0f}" class="meeting"/>'
        f'<text x="{(x0 + x1) / 2:.0f}" y="{(place[1] + policy[1]) / 2 + above:.0f}" class="words">{words}</text>'
    )


def _box(name: str, x: float, y: float) -> str:
    return (
        f'<rect x="{x - BOX[0] / 2:.0f}" y="{y - BOX[1] / 2:.0f}" width="{BOX[0]}" height="{BOX[1]}" rx="6"/>'
        f'<text x="{x:.0f}" y="{y + 5:.0f}">{name}</text>'
    )


STYLE = (
    "rect{fill:#eef3f8;stroke:#4a6785;stroke-width:1.5} text{font:14px sans-serif;text-anchor:middle;fill:#1c2733}"
    " .words{font-size:12px;fill:#4a6785} .meeting{stroke:#7b8ea3;stroke-dasharray:5 4}"
    " .arrow{stroke:#7b8ea3;stroke-width:1.4;marker-end:url(#head)}"
)
HEAD = (
    '<marker id="head" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
    '<path d="M0,0 L8,4 L0,8 z" fill="#7b8ea3"/></marker>'
)


def draw(pairs: set[tuple[str, str]]) -> str:
    """The picture as SVG; ``pairs`` as :func:`arrows` gives them."""
    places, total = _places(), 2 * TOP + BOX[1] + (len(FLOORS) - 1) * HEIGHT
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {total}" width="{WIDTH}" height="{total}">',
        f'<style>{STYLE}</style><defs>{HEAD}</defs><rect width="100%" height="100%" style="fill:white;stroke:none"/>',
        *(
            f'<path d="{_arrow(places[a], places[b])}" class="arrow"><title>{a} imports {b}</title></path>'
            for a, b in sorted(reduce(pairs))
        ),
        *(_meeting(places[name], places[POLICY], words) for name, words in MEETINGS.items()),
        *(_box(name, x, y) for name, (x, y) in places.items()),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PICTURE.write_text(draw(arrows()))
    print(f"Written: {PICTURE.relative_to(ROOT)}")
