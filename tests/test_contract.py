"""hdril and its policy never import each other; they meet in the dataset. What both write down must agree."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import lerobot_policy_hdril
import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot_policy_hdril import schema as policy_schema
from lerobot_policy_hdril.demonstrations import read_primitives
from lerobot_policy_hdril.graph import feature_names, group_nodes
from lerobot_policy_hdril.provenance import read_origin

from hdril import geometry
from hdril.demonstrations import read, schema
from hdril.demonstrations.provenance import read_provenance
from hdril.simulation.robots.spec import SIDES
from hdril.tasks import TASKS


@pytest.fixture(scope="module")
def metadata(dataset: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata("hdril/test", root=dataset)


def test_names_that_both_write_down_agree() -> None:
    assert policy_schema.POSE_AXES == geometry.POSE_AXES
    assert policy_schema.SUBTASKS_PATH == schema.SUBTASKS_PATH
    assert policy_schema.RECIPE_PATH == schema.RECIPE_PATH
    assert policy_schema.SUBTASK_KEY == schema.SUBTASK
    assert policy_schema.SUBTASK_START == schema.SUBTASK_START


def test_the_policy_makes_nodes_of_hands_and_objects(metadata: LeRobotDatasetMetadata) -> None:
    names = [
        name for key in (schema.STATE, schema.ENVIRONMENT_STATE) for name in feature_names(key, metadata.features[key])
    ]
    nodes = group_nodes(names)
    assert list(nodes) == [*SIDES, *TASKS["table_lift"].observed]
    assert [len(columns) for columns in nodes.values()] == [8, 8, 7]


def test_the_policy_reads_the_primitives(dataset: Path) -> None:
    assert tuple(read_primitives(dataset)) == read.read_primitives(dataset) == TASKS["table_lift"].labels


def test_the_policy_reads_who_made_the_dataset(dataset: Path, metadata: LeRobotDatasetMetadata) -> None:
    provenance = read_provenance(dataset)
    assert provenance is not None
    origin = read_origin(metadata, "")
    assert origin.task == provenance.recipe.task
    assert origin.seeds == provenance.seeds
    assert origin.recipe == provenance.recipe_digest


@pytest.mark.parametrize("names", [["p", "q"], {"left": ["p"], "right": ["q"]}, None, ["only one"]])
def test_both_name_the_numbers_of_a_feature_alike(names) -> None:
    feature = {"names": names, "shape": (2,)}
    assert tuple(feature_names("observation.state", feature)) == read.feature_names("observation.state", feature)


def test_the_policy_does_not_import_hdril() -> None:
    package = Path(str(lerobot_policy_hdril.__file__)).parent
    imported = {
        name.split(".")[0]
        for path in package.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        for name in (
            [alias.name for alias in node.names] if isinstance(node, ast.Import)
            else [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level
            else []
        )
    }  # fmt: skip
    assert "torch" in imported
    assert not imported & {"hdril", "pybullet"}


def test_the_digest_is_of_the_recipe_that_the_dataset_holds(dataset: Path, tmp_path: Path) -> None:
    """It changes with each value of the recipe, and not with the order of its keys."""
    provenance = read_provenance(dataset)
    assert provenance is not None
    values = json.loads((dataset / schema.RECIPE_PATH).read_text())
    copy = tmp_path / schema.RECIPE_PATH
    copy.parent.mkdir(parents=True)

    def digest(recipe: dict) -> str:
        copy.write_text(json.dumps(values | {"recipe": recipe}))
        changed = read_provenance(tmp_path)
        assert changed is not None
        return changed.recipe_digest

    recipe = values["recipe"]
    assert digest(dict(reversed(recipe.items()))) == provenance.recipe_digest
    others = [
        recipe | {"hdril_version": "0.0.0"},
        recipe | {"task": "peg_in_hole"},
        recipe | {"noise": {**recipe["noise"], "waypoint": 0.0}},
        recipe | {"physics": {**recipe["physics"], "substeps": recipe["physics"]["substeps"] + 1}},
    ]
    digests = {digest(other) for other in others}
    assert len(digests | {provenance.recipe_digest}) == 5
