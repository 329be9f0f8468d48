"""Graph attention over the state (paper, Section 4.1 and appendix A.3.1), dense: the graphs have at most ~30 nodes.

With node features h_u, a weight matrix W and a vector a, one head:

    e_uv = LeakyReLU(a^T [W h_u || W h_v])        alpha_uv = softmax_v(e_uv)        h'_u = sigma(sum_v alpha_uv W h_v)

Each module maps a state to an embedding, and tells who attended to whom.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_policy_hdril.coordinates import Origins, positive, unit
from lerobot_policy_hdril.graph import group_nodes, pose_columns

SLOPE = 0.2  # of LeakyReLU, as in the graph attention paper


class Interaction(Protocol):
    """What the encoders ask of a graph: (B, S) normalised and raw state to (B, out_dim), and attention (B, N, N)."""

    out_dim: int
    node_names: list[str]

    def __call__(self, normalised: Tensor, raw: Tensor) -> Tensor: ...

    def attention(self, normalised: Tensor, raw: Tensor) -> Tensor: ...


class NoInteraction(nn.Module):
    """The null graph: the state itself (the paper's models without Int)."""

    def __init__(self, names: list[str], node_dim: int) -> None:
        super().__init__()
        self.out_dim, self.node_names = len(names), list(names)

    def forward(self, normalised: Tensor, raw: Tensor) -> Tensor:
        return normalised

    def attention(self, normalised: Tensor, raw: Tensor) -> Tensor:
        """Nobody but oneself: the identity."""
        count = len(self.node_names)
        return torch.eye(count, device=raw.device).expand(len(raw), count, count)


def _attend(to: Tensor, source: Tensor, edge: Tensor | float = 0.0) -> Tensor:
    """alpha (B, N, N) from the two halves of a^T [.. || ..], (B, N) each, and an edge's share (B, N, N)."""
    return F.leaky_relu(to[:, :, None] + source[:, None, :] + edge, SLOPE).softmax(dim=-1)


class ScalarAttention(nn.Module):
    """The paper's graph: every number of the state is a node, all are connected, W has one column."""

    def __init__(self, names: list[str], node_dim: int) -> None:
        super().__init__()
        self.node_names, self.out_dim = list(names), len(names) * node_dim
        self.project = nn.Linear(1, node_dim, bias=False)
        self.score = nn.Linear(node_dim, 2, bias=False)  # a, cut in two

    def attention(self, normalised: Tensor, raw: Tensor) -> Tensor:
        to, source = self.score(self.project(normalised[..., None])).unbind(-1)
        return _attend(to, source)

    def forward(self, normalised: Tensor, raw: Tensor) -> Tensor:
        messages = self.project(normalised[..., None])  # (B, N, D)
        to, source = self.score(messages).unbind(-1)
        return F.elu(_attend(to, source) @ messages).flatten(1)


class ObjectAttention(nn.Module):
    """A node per hand and object, each with a projection of its own, which tells it apart; relative poses on the edges.

    The pose of v in the frame of u, r_uv, takes part in both the score and the message:

        e_uv = LeakyReLU(a^T [h_u || h_v || E r_uv])        h'_u = h_u + SiLU(sum_v alpha_uv (W h_v + M r_uv))
    """

    def __init__(self, names: list[str], node_dim: int) -> None:
        super().__init__()
        groups = group_nodes(names)
        self.node_names, self.out_dim = list(groups), len(groups) * node_dim
        width = max(len(indices) for indices in groups.values())
        # A state with a zero appended lets every node gather the same number of columns.
        columns = torch.full((len(groups), width), len(names))
        poses = torch.zeros(len(groups), 7, dtype=torch.long)
        has_pose = torch.zeros(len(groups))
        for node, indices in enumerate(groups.values()):
            columns[node, : len(indices)] = torch.tensor(indices)
            if (pose := pose_columns(names, indices)) is not None:
                poses[node] = torch.tensor([indices[column] for column in pose])
                has_pose[node] = 1.0
        self.register_buffer("columns", columns, persistent=False)
        self.register_buffer("poses", poses, persistent=False)
        # Positions are told in decimetres, to weigh as much as a rotation.
        scale = torch.tensor([10.0] * 3 + [1.0] * 4)
        self.register_buffer("edges", (has_pose[:, None] * has_pose)[..., None] * scale, persistent=False)
        self.embed = nn.Parameter(torch.randn(len(groups), width, node_dim) / width**0.5)
        self.identity = nn.Parameter(torch.randn(len(groups), node_dim))
        self.message = nn.Linear(node_dim, node_dim, bias=False)
        self.edge_message = nn.Linear(7, node_dim, bias=False)
        self.score = nn.Linear(node_dim, 2, bias=False)
        self.edge_score = nn.Linear(7, 1, bias=False)

    columns: Tensor
    poses: Tensor
    edges: Tensor

    def _nodes(self, normalised: Tensor) -> Tensor:
        features = F.pad(normalised, (0, 1))[:, self.columns].transpose(0, 1)  # (N, B, F)
        return (torch.bmm(features, self.embed) + self.identity[:, None]).transpose(0, 1)

    def _relations(self, raw: Tensor) -> Tensor:
        """r_uv (B, N, N, 7): position, dm, and quaternion; 0 without poses."""
        poses = raw[:, self.poses]
        position, quaternion = poses[..., :3], unit(poses[..., 3:])
        seen = Origins.at(position, quaternion).see(torch.cat([position, quaternion], dim=-1)[:, None])
        return positive(seen) * self.edges

    def _weights(self, nodes: Tensor, relations: Tensor) -> Tensor:
        to, source = self.score(nodes).unbind(-1)
        return _attend(to, source, self.edge_score(relations).squeeze(-1))

    def attention(self, normalised: Tensor, raw: Tensor) -> Tensor:
        return self._weights(self._nodes(normalised), self._relations(raw))

    def forward(self, normalised: Tensor, raw: Tensor) -> Tensor:
        nodes, relations = self._nodes(normalised), self._relations(raw)
        weights = self._weights(nodes, relations)
        # sum_v alpha_uv M r_uv = M sum_v alpha_uv r_uv: seven numbers a node instead of D on every edge.
        carried = (weights[:, :, None] @ relations).squeeze(2)
        update = weights @ self.message(nodes) + self.edge_message(carried)
        return (nodes + F.silu(update)).flatten(1)


INTERACTIONS: dict[str, Callable[[list[str], int], Interaction]] = {
    "none": NoInteraction,
    "scalar": ScalarAttention,
    "object": ObjectAttention,
}


def make_interaction(kind: str, names: list[str], node_dim: int) -> Interaction:
    """The graph of that kind over a state whose numbers have these names."""
    return INTERACTIONS[kind](names, node_dim)
