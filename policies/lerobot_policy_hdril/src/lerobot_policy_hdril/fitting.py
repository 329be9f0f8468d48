"""What is computed from the demonstrations rather than learned by gradient descent, from which episodes, and when.

LeRobot gives a policy the metadata of the whole dataset and tells the choice of episodes to the loader alone. So the policy
learns from the loader what it may use: an episode of which a training batch held a frame is learned from. LeRobot chooses
whole episodes, so the other frames of that episode are fair too. Held-out episodes never arrive in a training batch, and
nothing that is fitted sees them, whatever wraps or copies the dataset.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from lerobot_policy_hdril.demonstrations import Demonstrations, Window
from lerobot_policy_hdril.forms import FEWEST
from lerobot_policy_hdril.fusion import RIDGES, FusedMaps
from lerobot_policy_hdril.provenance import Origin, TrainingData, from_runs

if TYPE_CHECKING:
    from lerobot_policy_hdril.modeling_hdril import HDRILPolicy

NOISY_COPIES = 4
"""Disturbed copies of each window that tell how much noise of the hands moves what the fused maps see."""
GROWTH = 1
"""Fit anew when the episodes that are new are so many times those of the last fit, when all of the data set are there, ..."""
QUIET = 10
"""... or when so many batches in a row brought none. To fit all episodes anew after each straggler would cost more than
that gives: of 4,700 shuffled episodes, the last arrives after some 570 batches."""


class LearnedEpisodes:
    """The episodes that training has seen so far, and whether the fit is to follow them.

    The fit follows while this is the only dataset that the policy learned from. A policy that is fine-tuned on another one
    keeps its fit: its networks learned beside it.

    Args:
        known: the records of the checkpoint, empty for a new policy.
    """

    def __init__(self, demonstrations: Demonstrations, origin: Origin, known: list[TrainingData]) -> None:
        self._demonstrations, self._origin = demonstrations, origin
        self._others = [record for record in known if record.digest != origin.digest]
        self._fits = not self._others
        digests = [record.digest for record in known]
        self._position = digests.index(origin.digest) if origin.digest in digests else len(known)
        mine = known[self._position] if origin.digest in digests else TrainingData()
        seen = torch.isin(torch.tensor(demonstrations.episode_index), torch.tensor(from_runs(mine.episodes)))
        self.mask = seen.to(demonstrations.index.device)
        """(E,), True for an episode that was learned from."""
        self._count, self._fitted, self._quiet = int(seen.sum()), mine.fitted, mine.quiet

    def join(self, rows: Tensor) -> bool:
        """Take in the episodes of a training batch's rows (B,); returns whether the records changed.

        Processes that train together take in the batches of all.
        """
        if self._complete():
            return False
        here = torch.zeros_like(self.mask, dtype=torch.uint8)
        here[self._demonstrations.episode[rows]] = 1
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(here, torch.distributed.ReduceOp.MAX)
        self.mask |= here.bool()
        before, self._count = self._count, int(self.mask.sum())
        grew, waits = self._count > before, self._fits and self._count > self._fitted
        self._quiet = self._quiet + 1 if waits and not grew else 0
        return grew or waits

    def _complete(self) -> bool:
        """Whether no episode is left that could join, and no fit is due."""
        return self._count == len(self.mask) and (not self._fits or self._fitted == self._count)

    def fit_is_due(self) -> bool:
        """Whether to fit now. Depends on the stream of batches alone, and the record holds what it depends on: a resumed
        run fits where an uninterrupted one does."""
        if not self._fits or self._count == self._fitted:
            return False
        whole = self._count == len(self.mask)
        return whole or self._quiet >= QUIET or self._count - self._fitted >= GROWTH * self._fitted

    def mark_fitted(self) -> None:
        """The fit is now of all episodes that were seen."""
        self._fitted, self._quiet = self._count, 0

    def records(self) -> list[TrainingData]:
        """What the checkpoint is to say of all datasets that the policy learned from."""
        index = self._demonstrations.episode_index
        seen = [index[i] for i in self.mask.nonzero().flatten().tolist()]
        mine = self._origin.record(seen, self._fitted, self._quiet)
        return [*self._others[: self._position], mine, *self._others[self._position :]]


@torch.no_grad()
def fit(policy: HDRILPolicy, demonstrations: Demonstrations, episodes: Tensor) -> None:
    """Compute normalisation, lengths of primitives and linear maps from the episodes of the mask (E,), from scratch.

    All in float64 and in the order of the frames: the bits depend on the set of episodes alone.
    """
    with torch.autocast(demonstrations.state.device.type, enabled=False):
        policy.set_lengths(demonstrations.lengths(episodes))
        _fit_normalisation(policy, demonstrations, episodes)
        if policy.fused is not None:
            _fit_fused(policy, demonstrations, episodes)
        elif policy.config.state_skip:
            _fit_state_skips(policy, demonstrations, episodes)


def _fit_fused(policy: HDRILPolicy, demonstrations: Demonstrations, episodes: Tensor) -> None:
    """Solve the maps in every frame on all windows that training can draw."""
    frames, maps, config = policy.frames, policy.fused, policy.config
    assert frames is not None
    assert maps is not None
    states = demonstrations.state[episodes[demonstrations.episode]].double()
    single = frames.single(states)
    policy.feature_mean.copy_(single.mean(0)[frames.alike])
    policy.feature_std.copy_(single.std(0, correction=0).clamp_min(config.min_std)[frames.alike])
    if frames.fourier is not None:
        frames.fourier.fit(states, config.min_std)
    rows = demonstrations.replan_rows(policy.stride, episodes)
    executions = demonstrations.beginnings(episodes).sum(0)
    for k, form in enumerate(demonstrations.forms):
        # What is seldom shown is done as the primitive is done in general.
        alike = (
            [i for i, other in enumerate(demonstrations.forms) if other[0] == form[0]]
            if executions[k] < FEWEST
            else [k]
        )
        mine = torch.isin(demonstrations.label[rows], torch.tensor(alike, device=rows.device))
        window = _window(demonstrations, rows[mine], policy.stride, policy.ahead)
        features = policy.features(window.seen)[0]
        cast(FusedMaps, maps[k]).fit(
            features,
            torch.div(window.elapsed, policy.stride, rounding_mode="floor"),
            frames,
            window.seen,
            window.target[..., : len(config.action_names)],
            window.mask,
            [(*ridge, config.ridge_other) for ridge in RIDGES],
            config.robust,
            noise_covariance(policy, window, features),
            config.fusion_shrinkage,
        )


def noise_covariance(policy: HDRILPolicy, window: Window, features: Tensor) -> Tensor:
    """Second moments (W, W) of how far features (N, W) of windows are moved by noise of the hands."""
    total = features.new_zeros(features.shape[1], features.shape[1])
    if policy.hand_noise is None or not len(features):
        return total
    generator = torch.Generator(features.device).manual_seed(0)
    for _ in range(NOISY_COPIES):
        noisy = policy.hand_noise(window.seen, policy.state_std.double(), generator)
        moved = policy.features(noisy)[0] - features
        total += moved.T @ moved
    return total / (NOISY_COPIES * len(features))


def _window(demonstrations: Demonstrations, rows: Tensor, stride: int, length: int) -> Window:
    window = demonstrations.window(rows, stride, length)
    return replace(window, seen=window.seen.double(), target=window.target.double())


def _fit_normalisation(policy: HDRILPolicy, demonstrations: Demonstrations, episodes: Tensor) -> None:
    """Mean and deviation of what the models see and predict. LeRobot's statistics are of all episodes, also of those that
    are held out, and of the world's coordinates."""
    window = _window(demonstrations, demonstrations.replan_rows(0, episodes), 0, policy.capacity)
    state, output = demonstrations.state[episodes[demonstrations.episode]].double(), window.target
    parts: list[tuple[nn.Module, str, Tensor]] = [(policy, "state", state)]
    if policy.relational is not None:
        parts.append((policy.relational, "state", policy.relational.encode_state(state)))
        output = policy.relational.encode_output(output, window.state)
    parts.append((policy, "output", output[window.mask]))
    for owner, name, values in parts:
        owner.get_buffer(f"{name}_mean").copy_(values.mean(0))
        owner.get_buffer(f"{name}_std").copy_(values.std(0, correction=0).clamp_min(policy.config.min_std))


def _fit_state_skips(policy: HDRILPolicy, demonstrations: Demonstrations, episodes: Tensor) -> None:
    """Solve the linear maps on all windows that training can draw."""
    stride = policy.config.trained_replan_every
    rows = demonstrations.replan_rows(stride, episodes)
    for k in range(len(policy.dynamics)):
        mine = rows[demonstrations.label[rows] == k] if policy.config.per_primitive else rows
        window = _window(demonstrations, mine, stride, policy.capacity)
        skip = policy.model_of(k).state_skip
        assert skip is not None
        skip.fit(
            policy.linear_input(window.seen),
            policy.steps(window.elapsed),
            policy.target(window),
            window.mask,
            policy.config.ridge,
            policy.output_std[: len(policy.config.action_names)].double() if policy.config.robust else None,
        )
