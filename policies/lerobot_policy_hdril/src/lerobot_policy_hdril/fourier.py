"""Random Fourier features of where objects stand, for goals that are no linear function of that.

A table may be set down where it is held if its legs stand on the platform there: how far it is carried to the side is 0 up to a
point, and then grows. Linear maps cut such a corner.

Source: Rahimi and Recht, Random Features for Large-Scale Kernel Machines (NeurIPS 2007).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from lerobot_policy_hdril.coordinates import positive, unit

REACH = 0.1
"""Distance, m, over which a goal may bend: the length scale of the kernel. What observations are off by is far less."""
TURN = 0.3
"""The same for a quaternion's numbers."""
SPREAD = 2.0
"""The same for a number that is no pose's, such as a size, in standard deviations."""


class FourierFeatures(nn.Module):
    """Features i = 1 ... n of each object: of z, which is its pose in the world and all objects' numbers that are no pose's,

        8 / sqrt(n) cos(w_i z + b_i)        w_i ~ N(0, 1), b_i uniform in a turn

    so that the sum over i of the products of two states' features is about 32 exp(-|z - z'|^2 / 2), whatever n, and a ridge
    regression on them is about a Gaussian process. With n = 32 a feature varies as much as one that is normalised. Lengths are
    in :data:`REACH`, :data:`TURN` and :data:`SPREAD`.

    The w and b are drawn from a fixed seed, and part of the checkpoint.

    Args:
        poses: columns of a state (F, 7): the objects' poses.
        numbers: columns of a state that are objects' and no pose's.
        count: features of each object.
    """

    def __init__(self, poses: Tensor, numbers: list[int], count: int) -> None:
        super().__init__()
        self.register_buffer("poses", poses, persistent=False)
        self.register_buffer("numbers", torch.tensor(numbers, dtype=torch.long), persistent=False)
        self.register_buffer("owner", torch.arange(len(poses)).repeat_interleave(count), persistent=False)
        draw = torch.Generator().manual_seed(0)
        inputs = 7 + len(numbers)
        self.register_buffer("frequency", torch.randn(len(poses), inputs, count, generator=draw))
        self.register_buffer("phase", 2.0 * math.pi * torch.rand(len(poses), count, generator=draw))
        self.register_buffer("middle", torch.zeros(inputs))
        self.register_buffer("scale", torch.tensor([REACH] * 3 + [TURN] * 4 + [SPREAD] * len(numbers)))

    poses: Tensor
    numbers: Tensor
    owner: Tensor  # (F count,), the object of each feature
    frequency: Tensor  # (F, I, count)
    phase: Tensor  # (F, count)
    middle: Tensor  # (I,)
    scale: Tensor  # (I,)

    @torch.no_grad()
    def fit(self, states: Tensor, min_std: float) -> None:
        """Take the scale of what is no pose's from states (N, S): deviations, of at least ``min_std``."""
        values = states[:, self.numbers]
        self.middle[7:] = values.mean(0)
        self.scale[7:] = SPREAD * (values - values.mean(0)).square().mean(0).sqrt().clamp_min(min_std)

    def forward(self, state: Tensor) -> Tensor:
        """The features (B, F count) of states (B, S)."""
        poses = state[:, self.poses]  # (B, F, 7); a mean's quaternion is no unit one
        poses = positive(torch.cat([poses[..., :3], unit(poses[..., 3:])], dim=-1))
        numbers = state[:, None, self.numbers].expand(-1, len(self.poses), -1)
        inputs = (torch.cat([poses, numbers], dim=-1) - self.middle) / self.scale
        # No matrix product: in mixed precision that would be coarser than the features may be.
        angle = (inputs[..., None] * self.frequency).sum(-2) + self.phase
        return (8.0 / math.sqrt(self.phase.shape[1]) * torch.cos(angle)).flatten(1)
