"""The nearest demonstration, replayed: a baseline without a model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from lerobot.utils.device_utils import resolve_safetensors_device
from torch import Tensor, nn

from lerobot_policy_hdril.configuration_nearest import NearestConfig
from lerobot_policy_hdril.demonstrations import Demonstrations
from lerobot_policy_hdril.fitting import LearnedEpisodes
from lerobot_policy_hdril.provenance import read_origin
from lerobot_policy_hdril.weights import load_weights

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


_LEAST_SPREAD = 1e-3
"""m, or units of a quaternion's numbers: what varies less counts as if it varied by so much, because that is noise."""


class NearestPolicy(PreTrainedPolicy):
    """Replays the demonstration whose first state is nearest to the one that is seen at the start of an episode.

    The distance is Euclidean in the numbers of ``observation.state`` and ``observation.environment_state``, each divided by its
    standard deviation over the demonstrations' first states, or by 0.001 where that is less. After its last action a
    demonstration stays there.

    Args:
        config: see :class:`NearestConfig`.
        dataset_meta: the dataset to train on; without it, :meth:`forward` cannot run.

    Raises:
        ValueError: no dataset and nothing learned before, or a dataset that does not fit.
    """

    config_class: Any = NearestConfig
    name: Any = "nearest"

    def __init__(
        self, config: NearestConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **kwargs: Any
    ) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: NearestConfig = config
        self._demonstrations: Demonstrations | None = None
        if dataset_meta is not None:
            data = Demonstrations(dataset_meta, config.subtask_key, config.device or "cpu")
            if any(record.digest != data.digest for record in config.training_data):
                raise ValueError("nearest replays the demonstrations that it has: train it anew on other ones")
            config.episodes, config.longest = len(data.episode_index), data.longest_episode
            self._demonstrations = data
            self._learned = LearnedEpisodes(data, read_origin(dataset_meta, data.digest), config.training_data)
        if not config.episodes:
            raise ValueError("nearest replays demonstrations: train it with lerobot-train, or load a checkpoint")
        states = sum((config.input_features or {})[key].shape[0] for key in (OBS_STATE, OBS_ENV_STATE))
        assert config.action_feature is not None
        self.register_buffer("starts", torch.zeros(config.episodes, states))
        self.register_buffer("actions", torch.zeros(config.episodes, config.longest, config.action_feature.shape[0]))
        self.register_buffer("learned", torch.zeros(config.episodes, dtype=torch.bool))
        self.unused = nn.Parameter(torch.zeros(()))  # LeRobot optimises something, or refuses
        self.reset()

    starts: Tensor  # (E, S)
    actions: Tensor  # (E, T, A), the last action repeated
    learned: Tensor  # (E,)

    @classmethod
    def _load_as_safetensor[T: PreTrainedPolicy](cls, model: T, model_file: str, map_location: str, strict: bool) -> T:
        load_weights(model, Path(model_file), resolve_safetensors_device(map_location))
        return model

    def get_optim_params(self) -> Any:
        """One number, which changes nothing."""
        return self.parameters()

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Take in the episodes of the frames ``batch["index"]`` (B,). The loss is 0.

        Raises:
            RuntimeError: the policy was made without a dataset.
        """
        if self._demonstrations is None:
            raise RuntimeError("this policy was made without a dataset: train it with lerobot-train")
        rows = self._demonstrations.rows(batch["index"].to(self._demonstrations.index.device))
        if self.training and torch.is_grad_enabled() and self._learned.join(rows):
            self._learned.mark_fitted()
            self.config.training_data = self._learned.records()
            fresh = (self._learned.mask & ~self.learned).nonzero().flatten()
            history = self._demonstrations.episodes(fresh, self.config.longest)
            self.starts[fresh], self.actions[fresh], self.learned[fresh] = history.state, history.action, True
        return 0.0 * self.unused, {"demonstrations": float(self.learned.sum())}

    # ------------------------------------------------------------------ rollout

    def reset(self) -> None:
        """Forget the running episodes."""
        self._playing: tuple[Tensor, int] | None = None

    def nearest(self, state: Tensor) -> Tensor:
        """Demonstrations (B,) whose first states are nearest to states (B, S).

        Raises:
            RuntimeError: there are none.
        """
        if not self.learned.any():
            raise RuntimeError("this policy has learned nothing yet: train it with lerobot-train")
        known = self.starts[self.learned]
        scale = known.std(0, correction=0).clamp_min(_LEAST_SPREAD)
        # Not torch.cdist, which multiplies large matrices: numbers that hardly vary would cancel.
        apart = ((state[:, None] - known) / scale).square().sum(-1)
        return self.learned.nonzero().flatten()[apart.argmin(-1)]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The action (B, A) for this frame. The running episodes go on by a frame."""
        chosen, step = self._now(batch)
        self._playing = chosen, step + 1
        return self.actions[chosen, min(step, self.config.longest - 1)]

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The actions (B, N, A) from this frame to the end of the longest demonstration. Nothing is remembered."""
        chosen, step = self._now(batch)
        return self.actions[chosen, min(step, self.config.longest - 1) :]

    def _now(self, batch: dict[str, Tensor]) -> tuple[Tensor, int]:
        """The demonstrations (B,) that are replayed, and the frame of this action."""
        state = torch.cat([batch[key].flatten(0, -2) for key in (OBS_STATE, OBS_ENV_STATE)], dim=-1)
        if self._playing is None or len(self._playing[0]) != len(state):
            return self.nearest(state), 0
        return self._playing
