"""What the configurations of policies have in common that ask LeRobot's loader for single frames."""

from __future__ import annotations

from lerobot.configs.policies import PreTrainedConfig


class SingleFrameConfig(PreTrainedConfig):
    """Of a policy that looks up the rest of each trajectory in memory: windows through the loader are 50 times slower (see
    :mod:`lerobot_policy_hdril.demonstrations`)."""

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None
