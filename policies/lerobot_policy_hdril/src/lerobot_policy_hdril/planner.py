"""The planner (paper, Section 4.2): s_0 ... s_t to the primitive of the next step."""

from __future__ import annotations

from torch import Tensor, nn

from lerobot_policy_hdril.interaction import make_interaction


class Planner(nn.Module):
    """A graph GRU over the states seen so far, and a softmax over primitives at every frame.

    The paper omits the skip connection here, and so does this.
    """

    def __init__(self, names: list[str], primitives: int, interaction: str, hidden_dim: int, node_dim: int) -> None:
        super().__init__()
        self.graph = make_interaction(interaction, names, node_dim)
        self.gru = nn.GRU(self.graph.out_dim, hidden_dim, batch_first=True)
        self.head = nn.Sequential(nn.Linear(hidden_dim, hidden_dim), nn.SiLU(), nn.Linear(hidden_dim, primitives))

    def forward(self, normalised: Tensor, raw: Tensor, memory: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """States (B, T, S), and the memory (1, B, H) of what was before them, to logits (B, T, K) and the new memory."""
        batch, time, _ = normalised.shape
        nodes = self.graph(normalised.flatten(0, 1), raw.flatten(0, 1)).unflatten(0, (batch, time))
        hidden, last = self.gru(nodes, memory)
        return self.head(hidden), last
