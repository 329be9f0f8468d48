"""gym-aloha's tasks, by poses, for LeRobot: the environment type ``aloha_poses``.

LeRobot imports this module at the start of each of its commands; gym-aloha is imported when an environment is made.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from hdril.aloha.env import FPS, AlohaPosesEnv
from hdril.aloha.physics import require_extra
from hdril.aloha.tasks import TASKS, find_task
from hdril.lerobot_env import make_vector_env
from hdril.simulation.actions import ACTION_NAMES


@EnvConfig.register_subclass("aloha_poses")
@dataclass
class AlohaPosesConfig(EnvConfig):
    """The options of ``--env.type=aloha_poses``; ``task`` is transfer_cube or insertion.

    :meth:`create_envs` refuses what is not valid. draccus would swallow the reason of an error that is raised earlier.
    """

    task: str | None = "transfer_cube"
    fps: int = FPS
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(
        default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
    )

    def __post_init__(self) -> None:
        if self.task in TASKS:
            self.features = {
                ACTION: PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),)),
                "agent_pos": PolicyFeature(FeatureType.STATE, (len(ACTION_NAMES),)),
                "environment_state": PolicyFeature(FeatureType.ENV, (len(TASKS[self.task].state_names),)),
            }

    @property
    def gym_kwargs(self) -> dict:
        return {"render_mode": "rgb_array"}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment, by type and index, as LeRobot expects.

        Raises:
            ValueError: ``task`` is not valid.
            MissingExtraError: gym-aloha is not installed.
        """
        find_task(self.task or "")
        require_extra()
        factory = partial(AlohaPosesEnv, self.task, **self.gym_kwargs)
        return {self.type: {0: make_vector_env(factory, n_envs, use_async_envs)}}
