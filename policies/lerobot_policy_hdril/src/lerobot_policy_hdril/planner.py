"""The planner (paper, Section 4.2): s_0 ... s_t to the primitive of the next step."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_policy_hdril.decoders import run_gru
from lerobot_policy_hdril.interaction import make_interaction


class Planner(nn.Module):
    """A graph GRU over the states seen so far, and a softmax over primitives at every frame.

    The paper omits the skip connection here, and so does this.

    With ``steps``, the head is told as well which primitive plays and how many of its frames are over, and decides whether
    that goes on or one begins: the termination of an option (Sutton, Precup and Singh 1999).

    Args:
        steps: frames of the longest primitive; 0 for a head that sees the states alone.
    """

    def __init__(
        self, names: list[str], primitives: int, interaction: str, hidden_dim: int, node_dim: int, steps: int = 0
    ) -> None:
        super().__init__()
        self.graph = make_interaction(interaction, names, node_dim)
        self.gru = nn.GRU(self.graph.out_dim, hidden_dim, batch_first=True)
        self.steps = steps
        told, answers = (primitives + 1 + steps + 1, primitives + 1) if steps else (0, primitives)
        self.head = nn.Sequential(nn.Linear(hidden_dim + told, hidden_dim), nn.SiLU(), nn.Linear(hidden_dim, answers))
        # Rows are one-hot. For one frame, looking them up takes half the time that F.one_hot takes.
        self.register_buffer("which", torch.eye(primitives + 1), persistent=False)
        self.register_buffer("when", torch.eye(steps + 1), persistent=False)

    which: Tensor  # (K + 1, K + 1)
    when: Tensor  # (steps + 1, steps + 1)

    def forward(
        self,
        normalised: Tensor,
        raw: Tensor,
        memory: Tensor | None = None,
        playing: Tensor | None = None,
        elapsed: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """States (B, T, S), and the memory (1, B, H) of what was before them, to logits and the new memory.

        Without ``steps``, the logits (B, T, K) are of the primitives. With it, (B, T, K + 1): that the primitive that plays
        goes on, and that each one begins.

        Args:
            playing: the primitive at the frame before (B, T), K where there is none.
            elapsed: how many of its frames are over (B, T).
        """
        batch, time, _ = normalised.shape
        nodes = self.graph(normalised.flatten(0, 1), raw.flatten(0, 1)).unflatten(0, (batch, time))
        hidden, last = run_gru(self.gru, nodes, memory)
        if not self.steps:
            return self.head(hidden), last
        assert playing is not None
        assert elapsed is not None
        told = self.which[playing], self.when[elapsed.clamp_max(self.steps)]
        return self.head(torch.cat([hidden, *told], dim=-1)), last
