"""Which primitive plays, since when, and what is next: a policy's running episodes."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Protocol

import torch
from torch import Tensor

from lerobot_policy_hdril.configuration_hdril import HDRILConfig

MOST_DISCOUNTED = 3
"""So many beginnings count against a primitive (``repeat_discount``). With more, what the planner hardly finds possible would
begin for once; and where a task is done again and again in one episode, some primitives begin more often than others, as they
should."""


class Predictor(Protocol):
    """What playing asks of a policy."""

    config: HDRILConfig
    shortest_length: Tensor  # (K,), frames
    longest_length: Tensor  # (K,), frames; 0 for a primitive that was never learned
    alike: Tensor  # (K, K), bool: forms of one primitive

    def choose(self, state: Tensor, previous: PlaybackState | None) -> Choice:
        """What the planner says of states (B, S) that follow the frames of ``previous``."""
        ...

    def plan(self, seen: Tensor, primitive: Tensor, elapsed: Tensor) -> Tensor:
        """Actions and states (B, M, A + S) of the rest of primitives (B,), ``elapsed`` (B,) frames into them, from states and the
        means of the last ones (B, 1 + W, S)."""
        ...

    def fade(self, old: Tensor, new: Tensor, share: Tensor) -> Tensor:
        """Between rows of two plans (B, M, A + S) for the same frames: ``share`` (M, 1) of ``new``, and the rest of ``old``."""
        ...


@dataclass(frozen=True)
class Choice:
    """What a planner says of a frame of B episodes."""

    begin: Tensor  # (B, K), probability that each primitive begins; that each one is right, without `go_on`
    go_on: Tensor | None  # (B,), probability that the one that plays goes on, if the planner decides that
    memory: Tensor  # (1, B, H)

    def probabilities(self, playing: Tensor) -> Tensor:
        """(B, K): of each primitive at this frame, where ``playing`` (B,) was at the one before."""
        if self.go_on is None:
            return self.begin
        return self.begin.scatter_add(1, playing[:, None], self.go_on[:, None])


@dataclass(frozen=True)
class PlaybackState:
    """Where B running episodes are, at the frame of which the action is given next."""

    primitive: Tensor  # (B,)
    elapsed: Tensor  # (B,), frames of the primitive that are over
    plan: Tensor  # (B, M, A + S), from frame `plan_start` of the primitive on
    plan_start: Tensor  # (B,)
    replanned: Tensor  # (B,), whether the plan was made at this frame
    probabilities: Tensor  # (B, K), the planner's at this frame
    recent: Tensor  # (B, n, S), the last states, no more than the filters need: observed, or predicted in an open loop
    begun: Tensor  # (B, K), how often each primitive has begun, in any of its forms
    doubt: Tensor  # (B, K), hazard that each other primitive begins, added up since this one began for the first time in a row
    gave_up: Tensor  # (B,), the primitive that was given up at this frame; -1 where none was
    passed_over: Tensor  # (B,), the one that the planner preferred, and that had begun too often; -1 where none was
    memory: Tensor  # (1, B, H), the planner's

    @property
    def state(self) -> Tensor:
        """(B, S), the state at this frame."""
        return self.recent[:, -1]

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
        last = (longest_length[self.primitive] - self.plan_start).clamp_max(self.plan.shape[1]) - 1  # (B,)
        first = self.elapsed - self.plan_start
        ahead = first[:, None] + torch.arange(int((last - first).max()) + 1, device=self.plan.device)
        at = torch.minimum(ahead, last[:, None])[..., None].expand(-1, -1, self.plan.shape[-1])
        return self.plan.gather(1, at)


def advance(policy: Predictor, previous: PlaybackState | None, observed: Tensor) -> PlaybackState:
    """The next frame of episodes, of which ``observed`` (B, S) is seen; ``previous`` is None at their start.

    The planner is asked at every frame. From its shortest recorded length on, a primitive is over as soon as the planner
    prefers another, or, with ``termination=learned``, says that one begins; after its longest length it is over in any case.
    What begins is what the planner prefers, less for what has begun before, in any of its forms (``repeat_discount``). It may be
    the same one again, unless the planner's doubts have added up (``least_survival``): then what was doubted most begins in its
    place, less for what has begun before, too.

    A plan is made at the start of a primitive, and every ``replan_every`` frames; within a primitive, the last ``plan_overlap``
    frames of the plan before fade into it. In an open loop the state that was predicted for this frame takes the place of the
    one that is seen.
    """
    if previous is not None and len(previous.primitive) != len(observed):
        previous = None
    state = observed
    if previous is not None and policy.config.rollout == "open_loop":
        state = previous.row()[:, -observed.shape[-1] :]
    choice = policy.choose(state, previous)
    doubt = torch.zeros_like(choice.begin, dtype=torch.float32)
    if previous is not None and policy.config.least_survival:
        doubt = _doubt(previous, choice)
    primitive, elapsed, gave_up, passed_over = _next_primitive(policy, previous, choice, doubt)
    if previous is not None:
        doubt = torch.where((primitive == previous.primitive)[:, None], doubt, 0.0)
    probabilities = choice.begin if previous is None else choice.probabilities(previous.primitive)
    recent = state[:, None]
    if previous is not None:
        recent = torch.cat([previous.recent, recent], dim=1)[:, -max(policy.config.filters, default=1) :]
    begun = torch.zeros_like(choice.begin, dtype=torch.long) if previous is None else previous.begun
    begun = begun + (policy.alike[primitive] & (elapsed == 0)[:, None])
    replanned = elapsed == 0
    if policy.config.replan_every:
        replanned = elapsed % policy.config.replan_every == 0
    plan, plan_start = _next_plan(policy, previous, recent, primitive, elapsed, replanned)
    return PlaybackState(
        primitive=primitive,
        elapsed=elapsed,
        plan=plan,
        plan_start=plan_start,
        replanned=replanned,
        probabilities=probabilities,
        recent=recent,
        begun=begun,
        doubt=doubt,
        gave_up=gave_up,
        passed_over=passed_over,
        memory=choice.memory,
    )


def _doubt(previous: PlaybackState, choice: Choice) -> Tensor:
    """(B, K): -log of the probability that the primitive that plays survives all frames since it began, as a sum over what might
    have begun in its place. That it begins again is no doubt."""
    others = choice.begin.float().scatter(1, previous.primitive[:, None], 0.0)
    hazard = others.sum(-1, keepdim=True).clamp(1e-9, 1.0 - 1e-6)
    return previous.doubt - torch.log1p(-hazard) / hazard * others


def _next_primitive(
    policy: Predictor, previous: PlaybackState | None, choice: Choice, doubt: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Primitives (B,) of this frame, and how many of their frames are over; those that were given up and those that were passed
    over, -1 where none was."""
    highest, preferred = choice.begin.max(-1)
    nothing = torch.full_like(preferred, -1)
    if previous is None:
        return preferred, torch.zeros_like(preferred), nothing, nothing
    playing, elapsed = previous.primitive, previous.elapsed + 1
    wanted = preferred != playing if choice.go_on is None else highest > choice.go_on
    over = (elapsed >= policy.longest_length[playing]) | (wanted & (elapsed >= policy.shortest_length[playing]))
    discount = (1.0 - policy.config.repeat_discount) ** previous.begun.clamp(max=MOST_DISCOUNTED)
    best = (choice.begin * discount).argmax(-1)
    gave_up = torch.zeros_like(over)
    if policy.config.least_survival:
        doubted = over & (best == playing) & (doubt.sum(-1) > -math.log(policy.config.least_survival))
        best = torch.where(doubted, (doubt * discount).argmax(-1), best)
        gave_up = doubted & (preferred == playing)
    passed_over = over & (best != preferred) & ~gave_up
    return (
        torch.where(over, best, playing),
        torch.where(over, 0, elapsed),
        torch.where(gave_up, playing, nothing),
        torch.where(passed_over, preferred, nothing),
    )


def _next_plan(
    policy: Predictor,
    previous: PlaybackState | None,
    recent: Tensor,
    primitive: Tensor,
    elapsed: Tensor,
    due: Tensor,
) -> tuple[Tensor, Tensor]:
    """Plans, and the frames of the primitives at which they start; new ones for the episodes that are ``due`` (B,)."""
    if previous is None:
        return policy.plan(_seen(policy, recent), primitive, elapsed), elapsed
    if due.all():
        made = policy.plan(_seen(policy, recent), primitive, elapsed)
        return _fade_in(policy, previous.plan, made, elapsed), elapsed
    rows = due.nonzero().squeeze(-1)
    if not len(rows):
        return previous.plan, previous.plan_start
    made = policy.plan(_seen(policy, recent[rows]), primitive[rows], elapsed[rows])
    made = _fade_in(policy, previous.plan[rows], made, elapsed[rows])
    return previous.plan.index_copy(0, rows, made), torch.where(due, elapsed, previous.plan_start)


def _fade_in(policy: Predictor, before: Tensor, made: Tensor, elapsed: Tensor) -> Tensor:
    """Plans ``made`` (B, M, A + S) whose first ``plan_overlap`` rows are between them and the plans ``before``; where a primitive
    begins, ``elapsed`` (B,) is 0, and they stay as they are."""
    overlap, stride = policy.config.plan_overlap, policy.config.replan_every
    if not overlap or not elapsed.any():
        return made
    share = torch.arange(1, overlap + 1, dtype=made.dtype, device=made.device)[:, None] / (overlap + 1.0)
    faded = policy.fade(before[:, stride:], made[:, :overlap], share)
    return torch.cat([made[:, :overlap].where((elapsed == 0)[:, None, None], faded), made[:, overlap:]], dim=1)


def _seen(policy: Predictor, recent: Tensor) -> Tensor:
    """The last of states (B, n, S), and the means of the last ones (B, 1 + W, S)."""
    return torch.stack([recent[:, -1], *(recent[:, -frames:].mean(1) for frames in policy.config.filters)], dim=1)
