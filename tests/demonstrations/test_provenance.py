"""How a dataset was made: it is read back, and what this version cannot read is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hdril.demonstrations.provenance import RECIPE_PATH, Provenance, Recipe, read_provenance, write_provenance
from hdril.simulation.world import Physics
from hdril.tasks.primitives import Noise

MADE = Provenance(
    Recipe("table_lift", Noise(0.002), Physics(substeps=30), perturb=0.004, stray=0.02),
    (7, 9),
    {8: "table upright"},
    "0.0.9",
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A dataset of which only its provenance is there."""
    (tmp_path / RECIPE_PATH).parent.mkdir()
    write_provenance(tmp_path, MADE)
    return tmp_path


def test_provenance_is_read_back(root: Path) -> None:
    assert read_provenance(root) == MADE
    assert MADE.first_seed == 7
    assert Provenance(Recipe("table_lift"), (7, 9), {3: "table upright"}).first_seed == 3


def test_a_whole_number_may_stand_for_a_float(root: Path) -> None:
    path = root / RECIPE_PATH
    values = json.loads(path.read_text())
    values["recipe"]["noise"]["waypoint"] = 0
    path.write_text(json.dumps(values))
    read = read_provenance(root)
    assert read is not None
    assert read.recipe.noise == Noise(0.0)


def test_a_dataset_of_before_was_recorded_without_what_came_later(root: Path) -> None:
    path = root / RECIPE_PATH
    values = json.loads(path.read_text())
    del values["recipe"]["perturb"], values["recipe"]["stray"]
    path.write_text(json.dumps(values))
    read = read_provenance(root)
    assert read is not None
    assert read.recipe == replace(MADE.recipe, perturb=0.0, stray=0.0)


def test_a_dataset_of_others_has_none(tmp_path: Path) -> None:
    assert read_provenance(tmp_path) is None


Change = Callable[[dict[str, Any]], object]
CHANGES: dict[str, Change] = {
    "it has no field dropped": lambda values: values.pop("dropped"),
    "it has no field recipe": lambda values: values.pop("recipe"),
    "it has no field recipe.robot": lambda values: values["recipe"].pop("robot"),
    "it has no field recipe.hdril_version": lambda values: values["recipe"].pop("hdril_version"),
    "it has no field recipe.physics.gravity": lambda values: values["recipe"]["physics"].pop("gravity"),
    "it has an unknown field licence; known are: recipe, seeds, dropped": lambda values: values.update(licence="MIT"),
    "it has an unknown field recipe.wind; known are: task, ": lambda values: values["recipe"].update(wind=1.0),
    "it has an unknown field recipe.physics.wind; known are: timestep, ": (
        lambda values: values["recipe"]["physics"].update(wind=1.0)
    ),
    "recipe must be an object, not list": lambda values: values.update(recipe=[]),
    "recipe.noise must be an object, not float": lambda values: values["recipe"].update(noise=0.1),
    "recipe.noise.waypoint must be of type float, got 'much'": (
        lambda values: values["recipe"]["noise"].update(waypoint="much")
    ),
    "recipe.physics.substeps must be of type int, got 2.5": (
        lambda values: values["recipe"]["physics"].update(substeps=2.5)
    ),
    "recipe.perturb must be of type float, got 'some'": lambda values: values["recipe"].update(perturb="some"),
    "recipe.stray must be of type float, got 'far'": lambda values: values["recipe"].update(stray="far"),
    "recipe.task must be of type str, got 3": lambda values: values["recipe"].update(task=3),
    "unknown task 'chess'; choose from: ": lambda values: values["recipe"].update(task="chess"),
    "unknown robot 'dog'; choose from: ": lambda values: values["recipe"].update(robot="dog"),
    "noise.waypoint must be from 0 to 0.02 m, got 1.0": lambda values: values["recipe"]["noise"].update(waypoint=1.0),
    "seeds must be a list of integers, with one at least": lambda values: values.update(seeds=[]),
    "seeds must be a list of integers": lambda values: values.update(seeds=[7, "8"]),
    "dropped must be an object of texts by seed": lambda values: values.update(dropped={"x": "table upright"}),
    "dropped must be an object": lambda values: values.update(dropped=[8]),
}


@pytest.mark.parametrize("message", CHANGES)
def test_what_this_version_cannot_read_is_named(root: Path, message: str) -> None:
    path = root / RECIPE_PATH
    values = json.loads(path.read_text())
    CHANGES[message](values)
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match="cannot read") as caught:
        read_provenance(root)
    assert f"cannot read {path}: {message}" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff", b"[]"])
def test_a_damaged_file_is_named(root: Path, content: bytes) -> None:
    path = root / RECIPE_PATH
    path.write_bytes(content)
    with pytest.raises(ValueError, match="cannot read") as caught:
        read_provenance(root)
    assert str(path) in str(caught.value)
