"""What a policy tells of itself: for viewers and evaluations, which need not know how it is built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_policy_hdril.graph import group_nodes
from lerobot_policy_hdril.player import PlaybackState

if TYPE_CHECKING:
    from lerobot_policy_hdril.modeling_hdril import HDRILPolicy


@dataclass(frozen=True)
class Attention:
    """Who attends to whom, for B episodes: row u of a matrix says how much node u takes from each node, and sums to 1."""

    nodes: list[str]
    primitives: list[str]  # (B,), what each episode plays
    planner: Tensor  # (B, N, N)
    dynamics: Tensor  # (B, N, N), of the model of the primitive that plays; linear maps attend to nobody, and it is the identity

    def received(self, planner: bool = False) -> dict[str, Tensor]:
        """For every hand and object, the share (B,) of the dynamics model's attention that goes to it, or of the planner's, mean
        over all nodes; the shares sum to 1."""
        weights = self.planner if planner else self.dynamics
        return {name: weights[:, :, columns].sum(-1).mean(-1) for name, columns in group_nodes(self.nodes).items()}


@dataclass(frozen=True)
class Explanation:
    """What one episode of a policy is about, at the frame of its last action."""

    primitive: str
    """The primitive that plays."""
    probabilities: dict[str, float]
    """The planner's, by primitive; they sum to 1."""
    plan: NDArray[np.float32] | None
    """Actions (M, A) from this frame to the end of the plan, if it was made at this frame; None otherwise. It ends with
    the longest recorded form of the primitive, or before."""
    attention: dict[str, float]
    """Share of the dynamics model's attention that each hand and object receives, or of the planner's where the dynamics are
    linear maps, which attend to nobody; the shares sum to 1."""
    events: tuple[str, ...] = ()
    """What happened at this frame, in words."""


@torch.no_grad()
def attend(policy: HDRILPolicy, playback: PlaybackState) -> Attention:
    """The attention weights for the state that was seen at the frame of the last action."""
    seen, playing = playback.state, playback.primitive.tolist()
    given = policy.dynamics_input(seen)
    rows = [policy.model_of(k).graph.attention(given[i : i + 1], seen[i : i + 1]) for i, k in enumerate(playing)]
    return Attention(
        nodes=list(policy.planner.graph.node_names),
        primitives=[policy.config.form_names[k] for k in playing],
        planner=policy.planner.attention(policy.normalise(seen), seen),
        dynamics=torch.cat(rows),
    )


def explain(policy: HDRILPolicy, playback: PlaybackState, row: int) -> Explanation:
    """Plain values of one row of the batch."""
    names, attention = policy.config.form_names, attend(policy, playback.select(row))
    received = attention.received(planner=policy.config.decoder == "linear")
    plan = None
    if playback.replanned[row]:
        rest = playback.select(row).rest(policy.longest_length)
        plan = rest[0, :, : len(policy.config.action_names)].numpy(force=True).copy()
    probabilities = dict.fromkeys(policy.config.primitives, 0.0)
    for name, value in zip(names, playback.probabilities[row].tolist(), strict=True):
        probabilities[name] += value
    return Explanation(
        primitive=names[int(playback.primitive[row])],
        probabilities=probabilities,
        plan=plan,
        attention={name: float(share[0]) for name, share in received.items()},
        events=_events(names, playback, row),
    )


def _events(names: list[str], playback: PlaybackState, row: int) -> tuple[str, ...]:
    """A primitive that was given up, one that was passed over, and one that begins for the second time or later."""
    gave_up, passed_over, playing = (
        int(told[row]) for told in (playback.gave_up, playback.passed_over, playback.primitive)
    )
    events = []
    # For another form of the same one: to everybody else that is the same primitive.
    if gave_up >= 0 and names[gave_up] != names[playing]:
        events.append(f"{names[gave_up]} given up")
    if passed_over >= 0 and names[passed_over] != names[playing]:
        events.append(f"{names[passed_over]} passed over")
    if int(playback.elapsed[row]) == 0 and int(playback.begun[row, playing]) > 1:
        events.append(f"{names[playing]} tried again")
    return tuple(events)
