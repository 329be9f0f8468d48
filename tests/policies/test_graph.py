"""Names to nodes, and graph attention."""

from __future__ import annotations

import pytest
import torch
from lerobot_policy_hdril.coordinates import RelationalCoordinates
from lerobot_policy_hdril.graph import feature_names, group_nodes, pose_columns, pose_groups, quaternion_groups
from lerobot_policy_hdril.interaction import INTERACTIONS, SLOPE, ObjectAttention, ScalarAttention, make_interaction
from scipy.spatial.transform import Rotation
from torch.nn import functional as F
from torch_geometric.nn import GATConv, MessagePassing
from torch_geometric.utils import softmax

from hdril.geometry import Pose
from hdril.simulation.actions import ACTION_NAMES

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


def test_embedding_of_a_node_starts_with_variance_one_whatever_its_width() -> None:
    """A projection of w columns has weights of variance 1 / w, so that normalised inputs of that many keep their scale."""
    torch.manual_seed(0)
    graph = ObjectAttention(NAMES, 2048)
    width = max(len(indices) for indices in group_nodes(NAMES).values())
    assert graph.embed.shape[1] == width == 8
    assert graph.embed.std().item() == pytest.approx(width**-0.5, rel=0.05)


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


def flipped(state: torch.Tensor, groups: list[list[int]]) -> torch.Tensor:
    """The same poses, with the other sign of these quaternions."""
    other = state.clone()
    for group in groups:
        other[:, group] *= -1.0
    return other


@pytest.mark.parametrize("group", range(3))
def test_relations_do_not_depend_on_the_sign_of_a_quaternion(group: int) -> None:
    graph = ObjectAttention(NAMES, 16)
    state = states(6)
    other = flipped(state, [quaternion_groups(NAMES)[group]])
    torch.testing.assert_close(graph._relations(other), graph._relations(state))


def test_relational_coordinates_do_not_depend_on_the_sign_of_the_frames_quaternion() -> None:
    frame = RelationalCoordinates(NAMES, NAMES[16:], [*ACTION_NAMES, *NAMES])
    state = states(6)
    other = flipped(state, [quaternion_groups(NAMES)[2]])
    torch.testing.assert_close(frame.encode_state(other)[:, :16], frame.encode_state(state)[:, :16])
    output = torch.cat([states(6)[:, :16], states(6)], dim=-1)[:, None]
    torch.testing.assert_close(frame.encode_output(output, other), frame.encode_output(output, state))
    torch.testing.assert_close(frame.decode_output(output, other), frame.decode_output(output, state))


def complete(count: int) -> torch.Tensor:
    """Edges (2, count^2), source and target, of the complete graph with loops, sorted by target."""
    target, source = torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij")
    return torch.stack([source.flatten(), target.flatten()])


def test_scalar_attention_is_torch_geometrics_gatconv() -> None:
    """The paper's layer: one head, no bias, loops given as edges."""
    torch.manual_seed(0)
    ours, state, dim = ScalarAttention(NAMES, 16), states(6), 16
    theirs = GATConv(1, dim, heads=1, bias=False, add_self_loops=False, negative_slope=SLOPE)
    edges = complete(len(NAMES))
    with torch.no_grad():
        theirs.lin.weight.copy_(ours.project.weight)
        theirs.att_dst.copy_(ours.score.weight[0].view(1, 1, dim))
        theirs.att_src.copy_(ours.score.weight[1].view(1, 1, dim))
        mine, weights = ours(state, state), ours.attention(state, state)
        for row, one, attention in zip(state, mine, weights, strict=True):
            out, (_, alpha) = theirs(row[:, None], edges, return_attention_weights=True)
            torch.testing.assert_close(F.elu(out).flatten(), one, atol=1e-5, rtol=1e-5)
            torch.testing.assert_close(alpha.view(len(NAMES), len(NAMES)), attention, atol=1e-5, rtol=1e-5)


class SparseObjectAttention(MessagePassing):
    """ObjectAttention's equations, edge by edge, with torch_geometric's message passing and segment softmax."""

    def __init__(self, dense: ObjectAttention) -> None:
        super().__init__(aggr="add")
        self.dense = dense

    def forward(self, nodes: torch.Tensor, edges: torch.Tensor, relations: torch.Tensor) -> torch.Tensor:
        return nodes + F.silu(self.propagate(edges, h=nodes, r=relations))

    def message(self, h_i, h_j, r, index, ptr, size_i):
        to, source = self.dense.score.weight
        score = F.leaky_relu(h_i @ to + h_j @ source + r @ self.dense.edge_score.weight[0], SLOPE)
        alpha = softmax(score, index, ptr, size_i)
        return alpha[:, None] * (self.dense.message(h_j) + self.dense.edge_message(r))


def test_object_attention_is_torch_geometrics_message_passing() -> None:
    torch.manual_seed(0)
    ours, state = ObjectAttention(NAMES, 16), states(6)
    sparse, edges = SparseObjectAttention(ours), complete(3)
    with torch.no_grad():
        nodes, relations, mine = ours._nodes(state), ours._relations(state), ours(state, state)
        for i in range(len(state)):
            out = sparse(nodes[i], edges, relations[i].reshape(9, 7))
            torch.testing.assert_close(out.flatten(), mine[i], atol=1e-5, rtol=1e-5)


def test_nodes_without_a_pose_have_no_edges() -> None:
    """A node of one number, say the state of a switch, beside hands with poses."""
    names = [*ACTION_NAMES, "switch.state"]
    graph = ObjectAttention(names, 8)
    assert graph.node_names == ["left", "right", "switch"]
    assert graph.edges.bool().all(-1).tolist() == [[True, True, False], [True, True, False], [False] * 3]
    state = torch.cat([states(4)[:, : len(ACTION_NAMES)], torch.ones(4, 1)], dim=-1)
    relations = graph._relations(state)
    assert (relations[:, 2] == 0.0).all()
    assert (relations[:, :, 2] == 0.0).all()
    assert relations[:, 0, 1].abs().min() > 0.0
    assert graph(state, state).isfinite().all()


def test_object_attention_has_the_parameters_of_its_equation() -> None:
    """Projections, W, M, a and E: none has a bias."""
    shapes = {name: tuple(p.shape) for name, p in ObjectAttention(NAMES, 16).named_parameters()}
    assert shapes == {
        "embed": (3, 8, 16), "identity": (3, 16), "message.weight": (16, 16), "edge_message.weight": (16, 7),
        "score.weight": (2, 16), "edge_score.weight": (1, 7),
    }  # fmt: skip
    shapes = {name: tuple(p.shape) for name, p in ScalarAttention(NAMES, 16).named_parameters()}
    assert shapes == {"project.weight": (16, 1), "score.weight": (2, 16)}


def test_relational_coordinates_are_poses_in_the_objects_frame() -> None:
    left, right, table = pose_groups(NAMES)
    frame = RelationalCoordinates(NAMES, [NAMES[column] for column in table], [*ACTION_NAMES, *NAMES])
    state = states(4)
    seen = frame.encode_state(state)
    still = [column for column in range(len(NAMES)) if column not in {*left, *right}]  # the object, and the openings
    torch.testing.assert_close(seen[:, still], state[:, still])
    for row, other in zip(state.double().numpy(), seen.double().numpy(), strict=True):
        expected = Pose.from_vector(row[table]).inverse() @ Pose.from_vector(row[right])
        given = Pose.from_vector(other[right]).aligned_to(expected.quaternion)
        assert given.position == pytest.approx(expected.position, abs=1e-5)
        assert given.quaternion == pytest.approx(expected.quaternion, abs=1e-5)
    output = torch.cat([states(4)[:, : len(ACTION_NAMES)], states(4)], dim=-1)[:, None].repeat(1, 5, 1)
    back = frame.decode_output(frame.encode_output(output, state), state)
    torch.testing.assert_close(back, output, atol=1e-5, rtol=1e-5)
    with pytest.raises(ValueError, match="needs an object with a pose"):
        RelationalCoordinates(["a", "b"], ["b"], ["a"])
