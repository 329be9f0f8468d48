"""hdril's tasks for LeRobot: the environment type ``hdril`` and the gym ids."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from hdril.control import ACTION_NAMES
from hdril.env import BimanualEnv
from hdril.tasks import TASKS, get_task

for _task in TASKS.values():
    gym.register(id=_task.gym_id, entry_point="hdril.env:BimanualEnv", kwargs={"task": _task.name})


@EnvConfig.register_subclass("hdril")
@dataclass
class HDRILEnvConfig(EnvConfig):
    """``--env.type=hdril --env.task=…``. An unknown task is named by :meth:`create_envs`: draccus would swallow the reason
    of an error that is raised here."""

    task: str | None = "table_lift"
    robot: str = "baxter"
    fps: int = BimanualEnv.metadata["render_fps"]
    episode_length: int | None = None
    """Frames before an episode is cut; the task's horizon unless given."""
    meshes: bool = False
    """Draw the robot's meshes in videos instead of simple shapes: ten times as slow."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(
        default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
    )

    def __post_init__(self) -> None:
        try:
            spec = get_task(self.task or "")
        except ValueError:
            return
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(ACTION_NAMES),)),
            "environment_state": PolicyFeature(FeatureType.ENV, (7 * len(spec.observed),)),
        }

    @property
    def gym_id(self) -> str:
        return get_task(self.task or "").gym_id

    @property
    def gym_kwargs(self) -> dict:
        return {
            "robot": self.robot,
            "render_mode": "rgb_array",
            "max_episode_steps": self.episode_length,
            "meshes": self.meshes,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment, as LeRobot wants it. Raises ValueError if the task is unknown.

        Workers of an asynchronous one get a factory of this module, so that they import it: a gym id alone would not
        be known to them.
        """
        get_task(self.task or "")
        factories = [partial(make_env, self.task, **self.gym_kwargs)] * n_envs
        same_step = gym.vector.AutoresetMode.SAME_STEP
        if use_async_envs and n_envs > 1:
            vector = gym.vector.AsyncVectorEnv(factories, context="forkserver", autoreset_mode=same_step)
        else:
            vector = gym.vector.SyncVectorEnv(factories, autoreset_mode=same_step)
        return {self.type: {0: vector}}


def make_env(task: str, **kwargs) -> gym.Env:
    """An environment that stops simulating once its episode is over."""
    from lerobot.envs.utils import FreezeAfterEpisodeEnd

    return FreezeAfterEpisodeEnd(BimanualEnv(task, **kwargs))
