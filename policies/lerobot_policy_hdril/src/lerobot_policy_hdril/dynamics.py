"""The dynamics of one primitive (paper, Section 4.1): from the state at a frame, the actions and states that remain."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lerobot_policy_hdril.decoders import DECODERS, gru_step
from lerobot_policy_hdril.interaction import NoInteraction, make_interaction

FAR = 5.0
"""Medians of the distance from a robust fit, beyond which a demonstration is left out of it."""


FREE = 1e-6
"""Penalty on the constant of a map, which is as good as none."""


def ridge_penalty(inputs: Tensor, ridge: float) -> Tensor:
    """The penalty (D, D) on maps of inputs (N, D), the last of which is 1: that weight is free."""
    penalty = ridge * torch.eye(inputs.shape[1], dtype=inputs.dtype, device=inputs.device)
    penalty[-1, -1] = FREE
    return penalty


def solve_ridge(x: Tensor, y: Tensor, penalty: Tensor) -> tuple[Tensor, Tensor]:
    """The maps (..., W, D) of inputs x (N, D) to outputs y (..., N, W), with penalties (..., D, D), and their leave-one-out
    errors (..., N, W).

    The error of a row, had the map been solved without it, is its residual over 1 - h, with h = x (X^T X + P)^-1 x^T.
    """
    factor = torch.linalg.cholesky(x.T @ x + penalty)
    solution = torch.cholesky_solve(x.T @ y, factor)
    leverage = torch.linalg.solve_triangular(factor, x.T, upper=False).square().sum(-2).clamp_max(0.99)
    return solution.mT, (y - x @ solution) / (1.0 - leverage)[..., None]


def usual_windows(x: Tensor, y: Tensor, penalty: Tensor) -> Tensor:
    """Which windows (N,) are at most :data:`FAR` times as far as the median one from a robust fit of x (N, D) to y (N, W), by
    iteratively reweighted least squares."""
    weights = torch.ones_like(x[:, :1])
    far = torch.zeros_like(weights)
    for _ in range(3):
        solution = torch.linalg.solve(x.T @ (weights * x) + penalty, x.T @ (weights * y))
        far = (y - x @ solution).norm(dim=1, keepdim=True)
        weights = (2.0 * far.median() / far.clamp_min(1e-9)).square().clamp_max(1.0)
    return far[:, 0] <= FAR * far.median().clamp_min(1e-6)


class StateSkip(nn.Module):
    """A linear map from the state to the output of each step: ours, beside the paper's skip into the latent.

    A scripted or taught movement is close to linear in where it starts from and what it goes to, with other weights at
    each step. The maps are solved by ridge regression before training and then stay; the network learns the rest. Learned
    by gradient descent instead they fit as well, but answer wildly to states a little beside the demonstrated ones: on
    peg-in-hole 32 of 40 episodes succeeded so, and 500 of 500 with ridge regression.
    """

    def __init__(self, state_dim: int, out_dim: int, steps: int, stride: int) -> None:
        super().__init__()
        self.stride = stride or steps
        # One map per (first step, step): a plan made in the middle of a primitive weighs the state differently.
        starts = -(-steps // self.stride)
        self.register_buffer("weight", torch.zeros(starts, steps, out_dim, state_dim))
        self.register_buffer("bias", torch.zeros(starts, steps, out_dim))

    weight: Tensor
    bias: Tensor

    @torch.no_grad()
    def fit(
        self,
        normalised: Tensor,
        steps: Tensor,
        target: Tensor,
        mask: Tensor,
        ridge: float,
        scale: Tensor | None = None,
    ) -> None:
        """Solve the maps, in float64: W_i minimises sum_n |W_i [s_n || 1] - y_ni|^2 + ridge |W_i|^2, the bias is free.

        A step without a target has the map 0.

        With ``scale``, the fit is robust: windows are left out that are far off a first fit. Something went wrong at them, or
        the teacher mended something. A few of them in a hundred move a least-squares map by centimetres.

        Args:
            normalised: states (N, S) at which windows start.
            steps: step numbers (N, M); a window starts at a multiple of the stride.
            target: normalised outputs (N, M, W).
            mask: (N, M), True where there is a target: the first frames of a row, as many as it has.
            ridge: weight of the penalty; keeps the answer small in directions that the demonstrations do not vary in.
            scale: deviations (A,) that the first A outputs were normalised by: how far off a window is, is measured in these
                outputs' own units, m and numbers of quaternions.
        """
        self.weight.zero_()
        self.bias.zero_()
        inputs = torch.cat([normalised, torch.ones_like(normalised[:, :1])], dim=-1).double()
        penalty = ridge_penalty(inputs, ridge)
        for first in steps[:, 0].unique().tolist():
            starts_here = steps[:, 0] == first
            if scale is not None:
                distance = scale * target[:, 0, : len(scale)].double()
                starts_here = starts_here & mask[:, 0]
                near = usual_windows(inputs[starts_here], distance[starts_here], penalty)
                starts_here = starts_here.masked_scatter(starts_here, near)
            counts = (mask & starts_here[:, None]).sum(0).tolist()
            begin = 0
            for count, columns in groupby(counts):  # steps that the same rows have share their normal equations
                end = begin + len(list(columns))
                if count:
                    rows = (starts_here & mask[:, begin]).nonzero().squeeze(-1)
                    self._solve(first, begin, end, inputs[rows], target[rows, begin:end].double(), penalty)
                begin = end

    def _solve(self, first: int, begin: int, end: int, x: Tensor, y: Tensor, penalty: Tensor) -> None:
        """The maps of the steps ``begin`` to ``end`` of windows that start at ``first``: x (N, S + 1) to y (N, m, W)."""
        right = torch.einsum("ns,nmw->msw", x, y)
        solution = torch.linalg.solve(x.T @ x + penalty, right).transpose(1, 2).to(self.weight)  # (m, W, S + 1)
        row, steps = first // self.stride, slice(first + begin, first + end)
        self.weight[row, steps], self.bias[row, steps] = solution[..., :-1], solution[..., -1]

    def forward(self, normalised: Tensor, steps: Tensor) -> Tensor:
        """States (B, S) and step numbers (B, M), which start at multiples of the stride, to (B, M, W)."""
        firsts = steps[:, 0].unique().tolist()
        result = normalised.new_zeros(*steps.shape, self.weight.shape[2])
        for first in firsts:
            mine = (steps[:, 0] == first).nonzero().squeeze(-1)
            row, columns = first // self.stride, steps[mine[0]]
            part = torch.einsum("bs,mos->bmo", normalised[mine], self.weight[row, columns]) + self.bias[row, columns]
            result = result.index_copy(0, mine, part)
        return result


class PrimitiveDynamics(nn.Module):
    """Graph GRU encoder with the objects' skip connection, latent, decoder (paper, Figure 2).

        h = GRU(graph(s_t), 0)    [m, v] = FC([h || s_t^objects || c])    z = m + exp(v / 2) * noise
        y_i = FC([decoder_i(z) || z]) + L_i [s_t || f_t]

    f_t are as many means of the last states as ``means`` says. ``context`` c is empty for a model of one primitive, and says
    which primitive it is for a model of all. L is there with ``state_skip``; with ``residual``, other maps stand in for it.
    Without ``variational`` there is no v, and z = m. With the decoder ``linear`` there is nothing but L.
    """

    def __init__(
        self,
        names: list[str],
        skip_columns: list[int],
        context_dim: int,
        out_dim: int,
        steps: int,
        interaction: str,
        decoder: str,
        hidden_dim: int,
        node_dim: int,
        state_skip: bool,
        stride: int,
        variational: bool,
        means: int = 0,
        residual: bool = False,
    ) -> None:
        super().__init__()
        self.out_dim = out_dim
        seen = (1 + means) * len(names)
        self.state_skip = StateSkip(seen, out_dim, steps, stride) if state_skip else None
        self.has_network = decoder != "linear"
        if not self.has_network:
            # Nobody attends to another; the nodes are the planner's.
            self.graph = NoInteraction(make_interaction(interaction, names, node_dim).node_names, node_dim)
            return
        self.graph = make_interaction(interaction, names, node_dim)
        self.register_buffer("skip_columns", torch.tensor(skip_columns, dtype=torch.long), persistent=False)
        self.encoder = nn.GRUCell(self.graph.out_dim, hidden_dim)
        self.latent = nn.Sequential(
            nn.Linear(hidden_dim + len(skip_columns) + context_dim, hidden_dim),
            nn.SiLU(),
            nn.Linear(hidden_dim, 2 * hidden_dim if variational else hidden_dim),
        )
        self.variational = variational
        self.decoder = DECODERS[decoder](hidden_dim, steps)
        first, last = nn.Linear(2 * hidden_dim, hidden_dim), nn.Linear(hidden_dim, out_dim)
        self.head = nn.Sequential(first, nn.SiLU(), last)
        if state_skip or residual:  # the network starts from what the linear maps leave: nothing
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    skip_columns: Tensor

    def forward(
        self,
        normalised: Tensor,
        raw: Tensor,
        context: Tensor,
        steps: Tensor,
        linear: Tensor,
        samples: int = 0,
        stacked: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """States (B, S), context (B, C) and step numbers (B, M) to a prediction, and how far the latent is from its prior.

        Args:
            linear: what the linear maps see (B, (1 + means) S).
            samples: latents to draw and average over; 0 takes the mean latent. In training, one is drawn.
            stacked: called by :func:`predict_stacked` under vmap; leaves out the linear maps.

        Returns:
            Normalised actions and states (B, M, A + S), and KL(N(m, e^v) || N(0, 1)) (B,) in nats, 0 if deterministic.
        """
        if not self.has_network:
            assert self.state_skip is not None  # fused maps alone are called without this
            return self.state_skip(linear, steps), normalised.new_zeros(len(normalised))
        seen = self.graph(normalised, raw)
        if stacked:
            encoder, start = self.encoder, seen.new_zeros(len(seen), self.encoder.hidden_size)
            gates = nn.functional.linear(seen, encoder.weight_ih, encoder.bias_ih)
            hidden = gru_step(gates, start, encoder.weight_hh, encoder.bias_hh)
        else:
            hidden = self.encoder(seen)
        latent = self.latent(torch.cat([hidden, normalised[:, self.skip_columns], context], dim=-1))
        divergence = latent.new_zeros(len(latent))
        if self.variational:
            mean, log_variance = latent.chunk(2, dim=-1)
            divergence = 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance).sum(-1)
            noise = self._noise(mean, samples)
            latent = (mean + (0.5 * log_variance).exp() * noise).flatten(0, 1)
        copies = len(latent) // max(len(normalised), 1)
        decoded = self.decoder(latent, steps.repeat(copies, 1), stacked)
        output = self.head(torch.cat([decoded, latent[:, None].expand_as(decoded)], dim=-1))
        output = output.unflatten(0, (copies, len(normalised))).mean(0)
        if not stacked and self.state_skip is not None:
            output = output + self.state_skip(linear, steps)
        return output, divergence

    def _noise(self, mean: Tensor, samples: int) -> Tensor:
        """(draws, B or 1, H). Outside of training the draws are the same for every row and call: an episode does not depend
        on those it is batched with, and can be played again."""
        if self.training:
            return torch.randn_like(mean)[None]
        if not samples:
            return mean.new_zeros(1, 1, 1)
        generator = torch.Generator().manual_seed(0)
        return torch.randn(samples, 1, mean.shape[-1], generator=generator).to(mean)


def predict_stacked(
    models: Sequence[PrimitiveDynamics],
    normalised: Tensor,
    raw: Tensor,
    context: Tensor,
    steps: Tensor,
    linear: Tensor,
    which: Tensor,
    samples: int = 0,
) -> tuple[Tensor, Tensor]:
    """What each model's :meth:`~PrimitiveDynamics.forward` gives for its rows, all models in one batched call.

    The weights are stacked anew in each call, so that optimisers and checkpoints see the modules alone. Rows are padded to
    those of the busiest model. The linear maps are no part of it: their step numbers differ from row to row.

    Args:
        which: the model of each row (B,); the rest as in ``forward``.
    """
    present, group, counts = which.unique(return_inverse=True, return_counts=True)
    used = [models[k] for k in present.tolist()]
    order = group.argsort(stable=True)
    place = torch.arange(len(which), device=which.device) - (counts.cumsum(0) - counts)[group[order]]
    slot = torch.empty_like(place).index_copy(0, order, place)
    rows = torch.zeros(len(used), int(counts.max()), dtype=torch.long, device=which.device)
    rows[group, slot] = torch.arange(len(which), device=which.device)
    named = [dict(model.named_parameters()) for model in used]
    stacked = {name: torch.stack([parameters[name] for parameters in named]) for name in named[0]}
    # Buffers other than the linear maps, which are not called, are the same in all models.
    buffers = dict(used[0].named_buffers())

    def one(parameters: dict[str, Tensor], *inputs: Tensor) -> tuple[Tensor, Tensor]:
        return functional_call(used[0], (parameters, buffers), inputs, {"samples": samples, "stacked": True})

    # "same": sampled latents outside of training are those of a model called alone.
    batched = torch.vmap(one, randomness="same")
    output, divergence = batched(stacked, normalised[rows], raw[rows], context[rows], steps[rows], linear[rows])
    output, divergence = output[group, slot], divergence[group, slot]
    maps = {
        k: model.state_skip for k, model in zip(present.tolist(), used, strict=True) if model.state_skip is not None
    }
    if not maps:
        return output, divergence
    mapped = torch.empty_like(output)
    for k, skip in maps.items():
        mine = (which == k).nonzero().squeeze(-1)
        mapped = mapped.index_copy(0, mine, skip(linear[mine], steps[mine]))
    return output + mapped, divergence
