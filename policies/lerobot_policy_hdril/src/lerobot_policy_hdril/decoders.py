"""From a latent state to a trajectory (paper, appendix A.3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchdiffeq import odeint


class GRUDecoder(nn.Module):
    """A GRU whose first hidden state is the latent; its input at each step is the number of that step, embedded.

    The paper feeds the last output back instead. The hidden state already holds it, and without the feedback all steps
    of a batch run in one call.
    """

    def __init__(self, hidden_dim: int, steps: int) -> None:
        super().__init__()
        self.step = nn.Embedding(steps, hidden_dim // 4)
        self.gru = nn.GRU(hidden_dim // 4, hidden_dim, batch_first=True)

    def forward(self, latent: Tensor, steps: Tensor) -> Tensor:
        """Latent (B, H) and step numbers (B, M) to hidden states (B, M, H)."""
        hidden, _ = self.gru(self.step(steps), latent[None].contiguous())
        return hidden


class ODEDecoder(nn.Module):
    """dh/dt = f(h) from the latent, one unit of time a step (paper: "time invariant gradient function")."""

    def __init__(self, hidden_dim: int, steps: int) -> None:
        super().__init__()
        self.gradient = nn.Sequential(nn.Linear(hidden_dim, hidden_dim), nn.Tanh(), nn.Linear(hidden_dim, hidden_dim))
        self.steps = steps

    def forward(self, latent: Tensor, steps: Tensor) -> Tensor:
        """Latent (B, H) and step numbers (B, M) to hidden states (B, M, H)."""
        times = torch.arange(steps.shape[1] + 1, dtype=latent.dtype, device=latent.device) / self.steps
        path = odeint(lambda _, h: self.gradient(h), latent, times, method="rk4")
        return path[1:].transpose(0, 1)  # pyright: ignore


DECODERS: dict[str, type[nn.Module]] = {"gru": GRUDecoder, "ode": ODEDecoder}
