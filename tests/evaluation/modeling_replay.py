"""A policy for tests that plays recorded actions, whatever it sees: what it does is exact on any processor."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy

from tests.evaluation.configuration_replay import ReplayConfig


class ReplayPolicy(PreTrainedPolicy):
    """Plays the rows of ``actions`` (T, 16), the last one for ever, and explains itself if it has primitives."""

    config_class = ReplayConfig
    name = "replay"

    def __init__(self, config: ReplayConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config = config
        self.register_buffer("actions", torch.zeros(config.frames, 16))
        self.reset()

    def reset(self) -> None:
        self._frame = -1

    def get_optim_params(self) -> dict:
        return {}

    def forward(self, batch: dict) -> tuple[torch.Tensor, dict | None]:
        raise NotImplementedError

    def predict_action_chunk(self, batch: dict, **kwargs: Any) -> torch.Tensor:
        raise NotImplementedError

    def select_action(self, batch: dict, **kwargs: Any) -> torch.Tensor:
        self._frame += 1
        return self.actions[min(self._frame, len(self.actions) - 1)][None] * self.config.scale

    def explain(self, row: int = 0) -> SimpleNamespace | None:
        names, labels, frame = self.config.primitives, self.config.labels, min(self._frame, len(self.config.labels) - 1)
        if not names or self._frame < 0:
            return None
        now = labels[frame]
        starts = frame == 0 or labels[frame - 1] != now
        plan = self.actions[frame : frame + labels[frame:].count(now)].numpy() if starts else None
        return SimpleNamespace(
            primitive=names[now],
            probabilities={name: float(k == now) for k, name in enumerate(names)},
            plan=plan,
            attention={"left": 0.25, "table": 0.75},
            events=(f"{names[now]} begins",) if starts else (),
        )
