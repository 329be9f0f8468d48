"""How a dataset was made: the recipe and the seeds from which every episode can be made again."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hdril import __version__
from hdril.env import BimanualEnv
from hdril.simulation.world import Physics
from hdril.tasks import get_task
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise

RECIPE_PATH = "meta/hdril.json"
"""Where a dataset keeps its recipe and seeds."""


@dataclass(frozen=True)
class Recipe:
    """All that makes a demonstration, beside its seed: with both, any episode can be made again, bit for bit.

    ``physics`` is the task's own unless given.

    Raises:
        ValueError: unknown task or robot.
    """

    task: str
    noise: Noise = field(default_factory=Noise)
    physics: Physics | None = None
    robot: str = "baxter"

    def __post_init__(self) -> None:
        task = get_task(self.task)
        if self.physics is None:
            object.__setattr__(self, "physics", task.physics)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self) | {"hdril_version": __version__}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Recipe:
        return Recipe(values["task"], Noise(**values["noise"]), Physics(**values["physics"]), values["robot"])

    def make_env(self) -> BimanualEnv:
        return BimanualEnv(self.task, robot=self.robot, physics=self.physics)

    def make_expert(self) -> ScriptedExpert:
        return ScriptedExpert(get_task(self.task), self.noise)


@dataclass(frozen=True)
class Provenance:
    """How a dataset was made: its recipe and the seeds of its episodes, in order."""

    recipe: Recipe
    seeds: tuple[int, ...]


def read_provenance(root: Path) -> Provenance | None:
    """The recipe and seeds of a dataset; None for a dataset that hdril did not record."""
    path = root / RECIPE_PATH
    with suppress(FileNotFoundError):
        values = json.loads(path.read_text())
        return Provenance(Recipe.from_dict(values["recipe"]), tuple(values["seeds"]))
    return None
