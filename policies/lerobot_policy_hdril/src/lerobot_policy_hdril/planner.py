"""The planner (paper, Section 4.2): s_0 ... s_t to the primitive of the next step."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_policy_hdril.decoders import run_gru
from lerobot_policy_hdril.graph import pose_groups
from lerobot_policy_hdril.interaction import make_interaction

MOST = 10.0
"""No beginning counts more than so many times as much as the most frequent one: what one demonstration shows may be chance."""


def begin_weights(counts: Tensor, balance: float) -> Tensor:
    """How much the beginnings of primitives count in the planner's loss (K + 1, K): (the most frequent one's count / its own) to
    the power of ``balance``, and no more than :data:`MOST`. With 0, all count alike.

    Args:
        counts: how often each primitive begins after each, and where none was before (K + 1, K).
    """
    return (counts.max() / counts.clamp_min(1)).pow(balance).clamp_max(MOST)


class Planner(nn.Module):
    """A graph GRU over the states seen so far, and a softmax over primitives at every frame.

    The paper omits the skip connection here, and so does this.

    With ``steps``, the head is told as well which primitive plays and how many of its frames are over, and decides whether
    that goes on or one begins: the termination of an option (Sutton, Precup and Singh 1999).

    With ``scale``, it sees the position p of each pose a second time, as asinh(p / scale), in the frame that the poses are in. A
    state is normalised by how far an object gets. Beside that, this tells a few centimetres at the robot's middle, where they
    decide which hand is nearer.

    With ``dropout``, training leaves out that share of the embedded states' numbers, and of the hidden states' where the head
    reads them: the same ones at all frames of an episode, as Gal and Ghahramani (NeurIPS 2016) do. They drop what the memory
    hands on, too; here it is whole.

    Args:
        steps: frames of the longest primitive; 0 for a head that sees the states alone.
        scale: m; 0 for a planner that sees the normalised state alone.
        dropout: share of numbers, 0 to less than 1.
    """

    def __init__(
        self,
        names: list[str],
        primitives: int,
        interaction: str,
        hidden_dim: int,
        node_dim: int,
        steps: int = 0,
        scale: float = 0.0,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        positions = [i for pose in pose_groups(names) for i in pose[:3]] if scale else []
        # A part of a pose's name that is no axis: the numbers join the node of their object, and the pose stays what it is.
        self.graph = make_interaction(interaction, [*names, *(f"{names[i]}_scaled" for i in positions)], node_dim)
        self.register_buffer("positions", torch.tensor(positions, dtype=torch.long), persistent=False)
        self.scale, self.dropout = scale, dropout
        self.gru = nn.GRU(self.graph.out_dim, hidden_dim, batch_first=True)
        self.steps = steps
        told, answers = (primitives + 1 + steps + 1, primitives + 1) if steps else (0, primitives)
        self.head = nn.Sequential(nn.Linear(hidden_dim + told, hidden_dim), nn.SiLU(), nn.Linear(hidden_dim, answers))
        # Rows are one-hot. For one frame, looking them up takes half the time that F.one_hot takes.
        self.register_buffer("which", torch.eye(primitives + 1), persistent=False)
        self.register_buffer("when", torch.eye(steps + 1), persistent=False)

    positions: Tensor  # columns of the state
    which: Tensor  # (K + 1, K + 1)
    when: Tensor  # (steps + 1, steps + 1)

    def attention(self, normalised: Tensor, raw: Tensor) -> Tensor:
        """Attention weights (B, N, N) of states (B, S)."""
        return self.graph.attention(self.seen(normalised, raw), raw)

    def seen(self, normalised: Tensor, raw: Tensor) -> Tensor:
        """What the graph sees of states (..., S): what is normalised, and the positions on their second scale."""
        if not len(self.positions):
            return normalised
        return torch.cat([normalised, torch.asinh(raw[..., self.positions] / self.scale)], dim=-1)

    def _drop(self, values: Tensor, generator: torch.Generator | None) -> Tensor:
        """Values (B, T, D) without some of the D, others in each row."""
        if generator is None or not self.dropout:
            return values
        drawn = torch.rand(
            len(values), 1, values.shape[-1], generator=generator, dtype=values.dtype, device=values.device
        )
        return values * (drawn >= self.dropout) / (1.0 - self.dropout)

    def forward(
        self,
        normalised: Tensor,
        raw: Tensor,
        memory: Tensor | None = None,
        playing: Tensor | None = None,
        elapsed: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Tensor]:
        """States (B, T, S), and the memory (1, B, H) of what was before them, to logits and the new memory.

        Without ``steps``, the logits (B, T, K) are of the primitives. With it, (B, T, K + 1): that the primitive that plays
        goes on, and that each one begins.

        Args:
            playing: the primitive at the frame before (B, T), K where there is none.
            elapsed: how many of its frames are over (B, T).
            generator: draws what is left out; without it, nothing is.
        """
        batch, time, _ = normalised.shape
        flat = raw.flatten(0, 1)
        nodes = self._drop(
            self.graph(self.seen(normalised, raw).flatten(0, 1), flat).unflatten(0, (batch, time)), generator
        )
        hidden, last = run_gru(self.gru, nodes, memory)
        hidden = self._drop(hidden, generator)
        if not self.steps:
            return self.head(hidden), last
        assert playing is not None
        assert elapsed is not None
        told = self.which[playing], self.when[elapsed.clamp_max(self.steps)]
        return self.head(torch.cat([hidden, *told], dim=-1)), last
