"""Noise on the measured hands, so that a policy does not learn to follow itself.

In a demonstration, a hand is where it was told to be. Its pose and its opening tell the next action better than anything else
does. A policy that learns this follows its own errors, and they grow: causal confusion (de Haan et al., NeurIPS 2019). DART
(Laskey et al., CoRL 2017) disturbs the robot while demonstrations are recorded. Here the measured hands are disturbed while the
policy learns, also in rotation and opening, and the right action stays the teacher's.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_policy_hdril.coordinates import multiply, unit
from lerobot_policy_hdril.graph import pose_groups

ANGLE = 5.0
"""Deviation of the rotation about each axis, in rad for each metre of that of the position: a point 20 cm from the wrist moves as
far by the one as by the other."""
REST = 0.5
"""Noise of what is told and is no pose, such as an opening, in units of its deviation over the demonstrations."""


class HandNoise(nn.Module):
    """Disturbs the hands in states: their poses, and what an action has by the same name, such as an opening.

    Args:
        state_names: names of the numbers of ``observation.state``, which come first in a state.
        action_names: names of an action's numbers.
        deviation: standard deviation of a hand's position along each axis, m.
    """

    def __init__(self, state_names: list[str], action_names: list[str], deviation: float) -> None:
        super().__init__()
        hands = pose_groups(state_names)
        told = [i for i, name in enumerate(state_names) if name in action_names]
        rest = [i for i in told if not any(i in hand for hand in hands)]
        self.register_buffer("hands", torch.tensor(hands, dtype=torch.long).reshape(-1, 7), persistent=False)
        self.register_buffer("rest", torch.tensor(rest, dtype=torch.long), persistent=False)
        self.deviation = deviation

    hands: Tensor  # (G, 7), columns of the state
    rest: Tensor  # columns of the state that actions have too, and that are no pose's

    def forward(self, states: Tensor, std: Tensor, generator: torch.Generator) -> Tensor:
        """States (B, C, S), those of a row all disturbed alike; ``std`` (S,) is their deviation over the demonstrations."""

        def normal(*size: int) -> Tensor:
            return torch.randn(len(states), 1, *size, generator=generator, dtype=states.dtype, device=states.device)

        shift = self.deviation * normal(len(self.hands), 3)
        half = 0.5 * ANGLE * self.deviation * normal(len(self.hands), 3)
        turn = unit(torch.cat([half, torch.ones_like(half[..., :1])], dim=-1))
        rest = REST * std[self.rest] * normal(len(self.rest))
        poses, disturbed = states[..., self.hands], states.clone()  # (B, C, G, 7)
        disturbed[..., self.hands] = torch.cat([poses[..., :3] + shift, multiply(turn, poses[..., 3:])], dim=-1)
        disturbed[..., self.rest] = states[..., self.rest] + rest
        return disturbed
