"""hdril's tasks for LeRobot: the environment type ``hdril``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from hdril.env import BimanualEnv
from hdril.simulation.actions import ACTION_NAMES
from hdril.simulation.robots import ROBOTS
from hdril.tasks import get_task


@EnvConfig.register_subclass("hdril")
@dataclass
class HDRILEnvConfig(EnvConfig):
    """The options of ``--env.type=hdril``.

    :meth:`create_envs` refuses what is not valid. draccus would swallow the reason of an error that is raised earlier.
    """

    task: str | None = "table_lift"
    robot: str = "baxter"
    fps: int = BimanualEnv.metadata["render_fps"]
    episode_length: int | None = None
    """Frames after which an episode is cut; the task's budget unless given, and no fewer than its horizon."""
    meshes: bool = False
    """Draw the robot's meshes in videos instead of simple shapes, which is ten times as slow."""
    rerun: str = "none"
    """Episodes to keep as Rerun recordings: failures, all, none, or the number of episodes to keep of each environment.
    hdril-eval also records the policy's plans and probabilities, which an environment does not see."""
    rerun_dir: str = "outputs/rerun"
    """Folder of the recordings, one file for each episode."""
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
            "environment_state": PolicyFeature(FeatureType.ENV, (len(spec.state_names),)),
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

    @property
    def recordings(self) -> dict[str, str]:
        """The options of :func:`make_env` for Rerun recordings."""
        return {"keep": self.rerun, "folder": self.rerun_dir}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment, by type and index, as LeRobot expects.

        Raises:
            ValueError: ``task``, ``robot`` or ``rerun`` is not valid, or ``episode_length`` is below the task's horizon.
        """
        ROBOTS.find(self.robot)
        get_task(self.task or "").episode_limit(self.episode_length, "env.episode_length")
        if self.rerun != "none":
            from hdril.viewer.keep import check_keep

            check_keep("env.rerun", self.rerun)
        factory = partial(make_env, self.task, self.recordings, **self.gym_kwargs)
        return {self.type: {0: make_vector_env(factory, n_envs, use_async_envs)}}


def make_vector_env(factory: Callable[[], gym.Env], n_envs: int, use_async_envs: bool) -> gym.vector.VectorEnv:
    """``n_envs`` environments that are stepped together, in processes of their own if ``use_async_envs``."""
    same_step = gym.vector.AutoresetMode.SAME_STEP
    if use_async_envs and n_envs > 1:
        return gym.vector.AsyncVectorEnv([factory] * n_envs, context="forkserver", autoreset_mode=same_step)
    return gym.vector.SyncVectorEnv([factory] * n_envs, autoreset_mode=same_step)


def make_env(task: str, recordings: dict[str, str], **kwargs) -> gym.Env:
    """An environment that stops simulating once its episode is over, and writes Rerun recordings if it is asked to."""
    from lerobot.envs.utils import FreezeAfterEpisodeEnd

    env = BimanualEnv(task, **kwargs)
    if recordings["keep"] == "none":
        return FreezeAfterEpisodeEnd(env)
    # LeRobot imports this module at the start of each of its commands: Rerun is imported only if it is needed.
    from hdril.viewer.recorded_environment import RecordedEpisodes

    return FreezeAfterEpisodeEnd(RecordedEpisodes(env, recordings["keep"], Path(recordings["folder"])))
