"""How a dataset was made: the recipe and the seeds from which every episode can be made again."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from hdril import __version__
from hdril.actor import Actor
from hdril.demonstrations.perturb import PerturbedActor, check_perturbation
from hdril.digest import digest_json
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

    ``physics`` is the task's own unless given. ``perturb`` is the standard deviation, m, of noise that the robot's commands get
    and the recorded actions do not, and ``stray`` that of places beside its way to which a hand is sent now and then
    (:class:`~hdril.demonstrations.perturb.PerturbedActor`).

    Raises:
        ValueError: unknown task or robot, or a perturbation that is out of range.
    """

    task: str
    noise: Noise = field(default_factory=Noise)
    physics: Physics | None = None
    robot: str = "baxter"
    perturb: float = 0.0
    stray: float = 0.0

    def __post_init__(self) -> None:
        task = get_task(self.task)
        if self.robot not in ROBOTS:
            raise ValueError(f"unknown robot {self.robot!r}; choose from: {', '.join(ROBOTS)}")
        check_perturbation(self.perturb, self.stray)
        if self.physics is None:
            object.__setattr__(self, "physics", task.physics)

    @property
    def perturbed(self) -> bool:
        """Whether the robot is told something else than what is recorded."""
        return self.perturb > 0.0 or self.stray > 0.0

    def as_dict(self, hdril_version: str) -> dict[str, Any]:
        """The recipe and the version of hdril that plays it, for JSON."""
        return asdict(self) | {"hdril_version": hdril_version}

    def make_env(self) -> BimanualEnv:
        """The environment in which the expert demonstrates."""
        return BimanualEnv(self.task, robot=self.robot, physics=self.physics)

    def make_expert(self) -> Actor:
        """The expert that demonstrates."""
        expert = ScriptedExpert(get_task(self.task), self.noise)
        return PerturbedActor(expert, self.perturb, self.stray) if self.perturbed else expert


@dataclass(frozen=True)
class Provenance:
    """How a dataset was made: its recipe, the seeds of its episodes in order, and why which seeds were dropped.

    ``digest`` is that of its episodes (:func:`~hdril.demonstrations.content.dataset_digest`), empty before they are written and
    for datasets of before there were digests.
    """

    recipe: Recipe
    seeds: tuple[int, ...]
    dropped: dict[int, str] = field(default_factory=dict)
    hdril_version: str = __version__
    digest: str = ""

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
        return digest_json(self.recipe_values)


def write_provenance(root: Path, provenance: Provenance) -> None:
    """Write ``meta/hdril.json``."""
    values = {
        "recipe": provenance.recipe_values,
        "seeds": list(provenance.seeds),
        "dropped": {str(seed): why for seed, why in provenance.dropped.items()},
        "digest": provenance.digest,
    }
    (root / RECIPE_PATH).write_text(json.dumps(values, indent=2))


def read_provenance(root: Path) -> Provenance | None:
    """How a dataset was made; None for a dataset that hdril did not record.

    Raises:
        ValueError: ``meta/hdril.json`` is damaged, or another version of hdril wrote it; names the file and the field.
    """
    path = root / RECIPE_PATH
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        return None
    try:
        return _provenance(json.loads(text))
    except ValueError as error:  # of which JSONDecodeError and UnicodeDecodeError are kinds
        raise ValueError(f"hdril {__version__} cannot read {path}: {error}") from error


def _provenance(values: object) -> Provenance:
    if isinstance(values, dict):
        values = {"digest": ""} | values
    told = _named(values, "", ("recipe", "seeds", "dropped", "digest"))
    since = {"perturb": 0.0, "stray": 0.0}  # fields that datasets of earlier versions do not have
    recipe = since | told["recipe"] if isinstance(told["recipe"], dict) else told["recipe"]
    recipe = _named(recipe, "recipe", (*(entry.name for entry in fields(Recipe)), "hdril_version"))
    seeds, dropped = told["seeds"], told["dropped"]
    if not isinstance(seeds, list) or not seeds or not all(type(seed) is int for seed in seeds):
        raise ValueError("seeds must be a list of integers, with one at least")
    if not isinstance(dropped, dict) or not all(seed.isdecimal() and type(why) is str for seed, why in dropped.items()):
        raise ValueError("dropped must be an object of texts by seed")
    for name in ("task", "robot", "hdril_version"):
        _check_type(recipe[name], "", f"recipe.{name}")
    for name in ("perturb", "stray"):
        _check_type(recipe[name], 0.0, f"recipe.{name}")
    made = Recipe(
        task=recipe["task"],
        noise=_settings(Noise, recipe["noise"], "recipe.noise"),
        physics=_settings(Physics, recipe["physics"], "recipe.physics"),
        robot=recipe["robot"],
        perturb=recipe["perturb"],
        stray=recipe["stray"],
    )
    _check_type(told["digest"], "", "digest")
    why = {int(seed): reason for seed, reason in dropped.items()}
    return Provenance(made, tuple(seeds), why, recipe["hdril_version"], told["digest"])


def _named(values: object, where: str, names: Iterable[str]) -> dict[str, Any]:
    """An object of JSON that has the fields ``names`` and no others: a field that is not known may change what was made."""
    if not isinstance(values, dict):
        raise ValueError(f"{where or 'it'} must be an object, not {type(values).__name__}")
    prefix, names = where and f"{where}.", tuple(names)
    if missing := [name for name in names if name not in values]:
        raise ValueError(f"it has no field {prefix}{missing[0]}")
    if unknown := [name for name in values if name not in names]:
        raise ValueError(f"it has an unknown field {prefix}{unknown[0]}; known are: {', '.join(names)}")
    return values


def _settings[T: (Noise, Physics)](kind: type[T], values: object, where: str) -> T:
    """Settings of which each is of the type of its default."""
    told, default = _named(values, where, (entry.name for entry in fields(kind))), kind()
    for name, value in told.items():
        _check_type(value, getattr(default, name), f"{where}.{name}")
    return kind(**told)


def _check_type(value: object, like: object, where: str) -> None:
    """Raises ValueError unless ``value`` is of the same type as ``like``; an integer is a float, too."""
    if type(value) is not type(like) and not (type(like) is float and type(value) is int):
        raise ValueError(f"{where} must be of type {type(like).__name__}, got {value!r}")
