"""How a dataset was made: the recipe and the seeds from which every episode can be made again."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hdril import __version__
from hdril.env import BimanualEnv
from hdril.simulation.robots import ROBOTS
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
        if self.robot not in ROBOTS:
            raise ValueError(f"unknown robot {self.robot!r}; choose from: {', '.join(ROBOTS)}")
        if self.physics is None:
            object.__setattr__(self, "physics", task.physics)

    def as_dict(self, hdril_version: str) -> dict[str, Any]:
        """The recipe and the version of hdril that plays it, for JSON."""
        return asdict(self) | {"hdril_version": hdril_version}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Recipe:
        """The inverse of :meth:`as_dict`, but for the version."""
        return Recipe(values["task"], Noise(**values["noise"]), Physics(**values["physics"]), values["robot"])

    def make_env(self) -> BimanualEnv:
        """The environment in which the expert demonstrates."""
        return BimanualEnv(self.task, robot=self.robot, physics=self.physics)

    def make_expert(self) -> ScriptedExpert:
        """The expert that demonstrates."""
        return ScriptedExpert(get_task(self.task), self.noise)


@dataclass(frozen=True)
class Provenance:
    """How a dataset was made: its recipe, the seeds of its episodes in order, and why which seeds were dropped."""

    recipe: Recipe
    seeds: tuple[int, ...]
    dropped: dict[int, str] = field(default_factory=dict)
    hdril_version: str = __version__

    @property
    def first_seed(self) -> int:
        """The seed that was tried first."""
        return min((*self.seeds, *self.dropped))

    @property
    def recipe_values(self) -> dict[str, Any]:
        """The key ``recipe`` of ``meta/hdril.json``: the recipe, and the version of hdril that recorded."""
        return self.recipe.as_dict(self.hdril_version)

    @property
    def recipe_digest(self) -> str:
        """SHA-256, in hexadecimal, of :attr:`recipe_values` as canonical JSON (sorted keys, no spaces).

        Datasets with the same digest hold the same episode for the same seed.
        """
        text = json.dumps(self.recipe_values, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


def write_provenance(root: Path, provenance: Provenance) -> None:
    """Write ``meta/hdril.json``."""
    values = {
        "recipe": provenance.recipe_values,
        "seeds": list(provenance.seeds),
        "dropped": {str(seed): why for seed, why in provenance.dropped.items()},
    }
    (root / RECIPE_PATH).write_text(json.dumps(values, indent=2))


def read_provenance(root: Path) -> Provenance | None:
    """How a dataset was made; None for a dataset that hdril did not record."""
    with suppress(FileNotFoundError):
        values = json.loads((root / RECIPE_PATH).read_text())
        recipe, dropped = values["recipe"], values["dropped"]
        return Provenance(
            Recipe.from_dict(recipe),
            tuple(values["seeds"]),
            {int(seed): why for seed, why in dropped.items()},
            recipe["hdril_version"],
        )
    return None
