"""Which primitive plays, since when, and what is next: a policy's running episodes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import torch
from torch import Tensor

from lerobot_policy_hdril.configuration_hdril import HDRILConfig


class Predictor(Protocol):
    """What playing asks of a policy."""

    config: HDRILConfig
    shortest_length: Tensor  # (K,), frames
    longest_length: Tensor  # (K,), frames; 0 for a primitive that was never learned

    def choose(self, state: Tensor, memory: Tensor | None) -> tuple[Tensor, Tensor]:
        """States (B, S) and the planner's memory to probabilities (B, K) and the new memory."""
        ...

    def plan(self, state: Tensor, primitive: Tensor, elapsed: Tensor) -> Tensor:
        """Actions and states (B, M, A + S) of the rest of primitives (B,), ``elapsed`` (B,) frames into them."""
        ...


@dataclass(frozen=True)
class PlaybackState:
    """Where B running episodes are, at the frame of which the action is given next."""

    primitive: Tensor  # (B,)
    elapsed: Tensor  # (B,), frames of the primitive that are over
    plan: Tensor  # (B, M, A + S), from frame `plan_start` of the primitive on
    plan_start: Tensor  # (B,)
    replanned: Tensor  # (B,), whether the plan was made at this frame
    probabilities: Tensor  # (B, K), the planner's at this frame
    seen: Tensor  # (B, S), the state at this frame: observed, or predicted in an open loop
    memory: Tensor  # (1, B, H), the planner's

    def row(self) -> Tensor:
        """This frame's row (B, A + S) of the plan: the action, and the state that it leads to."""
        at = (self.elapsed - self.plan_start)[:, None, None].expand(-1, 1, self.plan.shape[-1])
        return self.plan.gather(1, at).squeeze(1)

    def select(self, row: int) -> PlaybackState:
        """One of the episodes, as a batch of one."""
        part = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        memory = part.pop("memory")[:, row : row + 1]
        return PlaybackState(**{name: value[row : row + 1] for name, value in part.items()}, memory=memory)

    def rest(self, longest_length: Tensor) -> Tensor:
        """The plan from this frame to its end (B, N, A + S). Where the ends differ, the last row is repeated."""
        last = longest_length[self.primitive] - self.plan_start - 1  # (B,)
        first = self.elapsed - self.plan_start
        ahead = first[:, None] + torch.arange(int((last - first).max()) + 1, device=self.plan.device)
        at = torch.minimum(ahead, last[:, None])[..., None].expand(-1, -1, self.plan.shape[-1])
        return self.plan.gather(1, at)


def advance(policy: Predictor, previous: PlaybackState | None, observed: Tensor) -> PlaybackState:
    """The next frame of episodes, of which ``observed`` (B, S) is seen; ``previous`` is None at their start.

    The planner is asked at every frame. A primitive is over after its longest recorded length, or from its shortest on as
    soon as the planner prefers another; the planner may then choose the same one again. A plan is made at the start of a
    primitive, and every ``replan_every`` frames. In an open loop the state that was predicted for this frame takes the
    place of the one that is seen.
    """
    if previous is not None and len(previous.primitive) != len(observed):
        previous = None
    state = observed
    if previous is not None and policy.config.rollout == "open_loop":
        state = previous.row()[:, -observed.shape[-1] :]
    probabilities, memory = policy.choose(state, None if previous is None else previous.memory)
    primitive, elapsed = _next_primitive(policy, previous, probabilities.argmax(-1))
    replanned = elapsed == 0
    if policy.config.replan_every:
        replanned = elapsed % policy.config.replan_every == 0
    plan, plan_start = _next_plan(policy, previous, state, primitive, elapsed, replanned)
    return PlaybackState(primitive, elapsed, plan, plan_start, replanned, probabilities, state, memory)


def _next_primitive(policy: Predictor, previous: PlaybackState | None, best: Tensor) -> tuple[Tensor, Tensor]:
    """Primitives (B,) of this frame, and how many of their frames are over."""
    if previous is None:
        return best, torch.zeros_like(best)
    playing, elapsed = previous.primitive, previous.elapsed + 1
    over = elapsed >= policy.longest_length[playing]
    over |= (elapsed >= policy.shortest_length[playing]) & (best != playing)
    return torch.where(over, best, playing), torch.where(over, 0, elapsed)


def _next_plan(
    policy: Predictor,
    previous: PlaybackState | None,
    state: Tensor,
    primitive: Tensor,
    elapsed: Tensor,
    due: Tensor,
) -> tuple[Tensor, Tensor]:
    """Plans, and the frames of the primitives at which they start; new ones for the episodes that are ``due`` (B,)."""
    if previous is None:
        return policy.plan(state, primitive, elapsed), elapsed
    if not due.any():
        return previous.plan, previous.plan_start
    rows = due.nonzero().squeeze(-1)
    plan = previous.plan.index_copy(0, rows, policy.plan(state[rows], primitive[rows], elapsed[rows]))
    return plan, torch.where(due, elapsed, previous.plan_start)
