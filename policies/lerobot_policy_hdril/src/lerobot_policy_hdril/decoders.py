"""From a latent state to a trajectory (paper, appendix A.3.2)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torchdiffeq import odeint


def gru_step(gates: Tensor, hidden: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """One step of PyTorch's GRU, written out, because vmap has no rule for it.

    Args:
        gates: the input's share of reset, update and new gate (B, 3 H).
        hidden: (B, H).
        weight: weight_hh (3 H, H).
        bias: bias_hh (3 H,).
    """
    reset, update, new = gates.chunk(3, dim=-1)
    hidden_reset, hidden_update, hidden_new = nn.functional.linear(hidden, weight, bias).chunk(3, dim=-1)
    update = (update + hidden_update).sigmoid()
    new = (new + (reset + hidden_reset).sigmoid() * hidden_new).tanh()
    return new + update * (hidden - new)


def run_gru(gru: nn.GRU, inputs: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Call ``gru``, which puts the batch first: of inputs (B, T, D) and a hidden state (1, B, H), the hidden states (B, T, H) and
    the last one (1, B, H). A single step takes a third of the time of the module's call."""
    if inputs.shape[1] != 1:
        return gru(inputs, hidden)
    if hidden is None:
        hidden = inputs.new_zeros(1, len(inputs), gru.hidden_size)
    last = torch.gru_cell(inputs[:, 0], hidden[0], *gru.all_weights[0])
    return last[:, None], last[None]


class GRUDecoder(nn.Module):
    """A GRU whose first hidden state is the latent; its input at each step is the number of that step, embedded.

    The paper feeds the last output back instead. The hidden state already holds it, and without the feedback all steps
    of a batch run in one call.
    """

    def __init__(self, hidden_dim: int, steps: int) -> None:
        super().__init__()
        self.step = nn.Embedding(steps, hidden_dim // 4)
        self.gru = nn.GRU(hidden_dim // 4, hidden_dim, batch_first=True)

    def forward(self, latent: Tensor, steps: Tensor, stacked: bool = False) -> Tensor:
        """Latent (B, H) and step numbers (B, M) to hidden states (B, M, H); ``stacked`` under vmap."""
        if stacked:
            weight_ih, weight_hh, bias_ih, bias_hh = self.gru.all_weights[0]
            hidden, path = latent, []
            for gates in nn.functional.linear(self.step(steps), weight_ih, bias_ih).unbind(1):
                hidden = gru_step(gates, hidden, weight_hh, bias_hh)
                path.append(hidden)
            return torch.stack(path, dim=1)
        return run_gru(self.gru, self.step(steps), latent[None].contiguous())[0]


class ODEDecoder(nn.Module):
    """dh/dt = f(h) from the latent, one unit of time a step (paper: "time invariant gradient function")."""

    def __init__(self, hidden_dim: int, steps: int) -> None:
        super().__init__()
        self.gradient = nn.Sequential(nn.Linear(hidden_dim, hidden_dim), nn.Tanh(), nn.Linear(hidden_dim, hidden_dim))
        self.steps = steps

    def forward(self, latent: Tensor, steps: Tensor, stacked: bool = False) -> Tensor:
        """Latent (B, H) and step numbers (B, M) to hidden states (B, M, H)."""
        times = torch.arange(steps.shape[1] + 1, dtype=latent.dtype, device=latent.device) / self.steps
        path: Any = odeint(lambda _, h: self.gradient(h), latent, times, method="rk4")
        return path[1:].transpose(0, 1)


DECODERS: dict[str, type[nn.Module]] = {"gru": GRUDecoder, "ode": ODEDecoder}
