"""The card of a dataset says what made it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import draccus

from hdril.cli.record import RecordConfig
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import RECIPE_PATH, Provenance, Recipe
from hdril.demonstrations.write import write_dataset
from hdril.hub.cards import dataset_card
from hdril.tasks.primitives import Noise


def test_a_card_has_the_recipe_of_the_version_that_recorded(made_up: Callable[..., Episode], tmp_path: Path) -> None:
    root = tmp_path / "set"
    dropped = {5: "table upright", 8: "table upright"}
    write_dataset(root, Provenance(Recipe("table_lift"), (6, 7), dropped, "0.0.9"), [made_up(6), made_up(7)])
    card = dataset_card("user/name", root)
    recipe = json.loads(card.partition("## Recipe")[2].partition("```json\n")[2].partition("```")[0])
    assert recipe == json.loads((root / RECIPE_PATH).read_text())["recipe"]
    assert recipe["hdril_version"] == "0.0.9"
    assert "2 of\n4 that were tried failed" in card


def test_the_command_of_a_card_makes_the_dataset(made_up: Callable[..., Episode], tmp_path: Path) -> None:
    recipe = Recipe("table_lift", Noise(0.003), perturb=0.004, stray=0.02)
    write_dataset(tmp_path / "set", Provenance(recipe, (6, 7)), [made_up(6), made_up(7)])
    used = dataset_card("user/name", tmp_path / "set").partition("## Use")[2]
    command = used.partition("hdril-record ")[2].partition("lerobot-train")[0]
    config = draccus.parse(RecordConfig, args=command.replace("\\", " ").split())
    assert Recipe(config.task, config.noise, perturb=config.perturb, stray=config.stray) == recipe
    assert (config.num_episodes, config.seed, config.repo_id) == (2, 6, "user/name")
