"""Names to nodes, and graph attention."""

from __future__ import annotations

import pytest
import torch
from lerobot_policy_hdril.graph import feature_names, group_nodes, pose_columns, quaternion_groups
from lerobot_policy_hdril.interaction import INTERACTIONS, make_interaction
from scipy.spatial.transform import Rotation

from hdril.control import ACTION_NAMES
from hdril.geometry import Pose

NAMES = [*ACTION_NAMES, *(f"table.{axis}" for axis in ("x", "y", "z", "qx", "qy", "qz", "qw"))]


def states(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(count, len(NAMES), generator=generator)
    for group in quaternion_groups(NAMES):
        state[:, group] = torch.nn.functional.normalize(state[:, group], dim=-1)
    return state


def test_hands_and_objects_are_nodes() -> None:
    nodes = group_nodes(NAMES)
    assert list(nodes) == ["left", "right", "table"]
    assert nodes["right"] == list(range(8, 16))
    assert pose_columns(NAMES, nodes["table"]) == list(range(7))
    assert quaternion_groups(NAMES) == [[3, 4, 5, 6], [11, 12, 13, 14], [19, 20, 21, 22]]


def test_names_that_a_dataset_may_have() -> None:
    assert feature_names("action", {"names": ["a.pos", "b.pos"], "shape": (2,)}) == ["a.pos", "b.pos"]
    assert feature_names("action", {"names": {"motors": ["a", "b"]}, "shape": (2,)}) == ["a", "b"]
    assert feature_names("observation.state", {"names": None, "shape": (2,)}) == ["state.0", "state.1"]
    assert pose_columns(["a", "b"], [0, 1]) is None


@pytest.mark.parametrize("kind", INTERACTIONS)
def test_attention_is_a_distribution_over_named_nodes(kind: str) -> None:
    graph = make_interaction(kind, NAMES, 16)
    state = states(5)
    weights = graph.attention(state, state)
    count = len(graph.node_names)
    assert weights.shape == (5, count, count)
    torch.testing.assert_close(weights.sum(-1), torch.ones(5, count))
    assert (weights >= 0).all()
    assert graph(state, state).shape == (5, graph.out_dim)


@pytest.mark.parametrize("kind", INTERACTIONS)
def test_samples_do_not_mix(kind: str) -> None:
    torch.manual_seed(0)
    graph = make_interaction(kind, NAMES, 16)
    state = states(4)
    alone = torch.cat([graph(one[None], one[None]) for one in state])
    torch.testing.assert_close(graph(state, state), alone)


def test_edges_carry_relative_poses() -> None:
    graph = make_interaction("object", NAMES, 16)
    state = states(3)
    relations = graph._relations(state)
    nodes = group_nodes(NAMES)
    for sample in range(3):
        for i, u in enumerate(nodes.values()):
            for j, v in enumerate(nodes.values()):
                expected = Pose(*_split(state[sample, u])).inverse() @ Pose(*_split(state[sample, v]))
                torch.testing.assert_close(
                    relations[sample, i, j, :3],
                    torch.tensor(10 * expected.position, dtype=torch.float32),
                    atol=1e-4,
                    rtol=1e-4,
                )
                turn = Rotation.from_quat(relations[sample, i, j, 3:].numpy(force=True)).inv() * Rotation.from_quat(
                    expected.quaternion
                )
                assert turn.magnitude() < 1e-3


def _split(numbers: torch.Tensor) -> tuple:
    return numbers[:3].numpy(), numbers[3:7].numpy()


def test_relations_do_not_depend_on_where_the_scene_is() -> None:
    graph = make_interaction("object", NAMES, 16)
    state = states(4)
    moved = state.clone()
    for node in group_nodes(NAMES).values():
        moved[:, node[:3]] += torch.tensor([0.3, -0.2, 0.1])
    torch.testing.assert_close(graph._relations(moved), graph._relations(state), atol=1e-4, rtol=1e-4)
