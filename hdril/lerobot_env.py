"""hdril's tasks for LeRobot: the environment type ``hdril`` and the gym ids."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from hdril.env import BimanualEnv
from hdril.simulation.actions import ACTION_NAMES
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
    rerun: str = "none"
    """Episodes to keep as Rerun recordings: failures, all, none, or a number of episodes from an environment's first on.
    hdril-eval also records what the policy planned and believed, which an environment does not see."""
    rerun_dir: str = "outputs/rerun"
    """Folder of the recordings, a file each."""
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

    @property
    def recordings(self) -> dict[str, str]:
        """What :func:`make_env` wants to know of Rerun recordings."""
        return {"keep": self.rerun, "folder": self.rerun_dir}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment, as LeRobot wants it. Raises ValueError if the task or ``rerun`` is not a valid one.

        Workers of an asynchronous one get a factory of this module, so that they import it: a gym id alone would not
        be known to them.
        """
        get_task(self.task or "")
        if self.rerun != "none":
            from hdril.viewer.keep import check_keep

            check_keep("env.rerun", self.rerun)
        factories = [partial(make_env, self.task, self.recordings, **self.gym_kwargs)] * n_envs
        same_step = gym.vector.AutoresetMode.SAME_STEP
        if use_async_envs and n_envs > 1:
            vector = gym.vector.AsyncVectorEnv(factories, context="forkserver", autoreset_mode=same_step)
        else:
            vector = gym.vector.SyncVectorEnv(factories, autoreset_mode=same_step)
        return {self.type: {0: vector}}


def make_env(task: str, recordings: dict[str, str], **kwargs) -> gym.Env:
    """An environment that stops simulating once its episode is over, and writes Rerun recordings if it is told to."""
    from lerobot.envs.utils import FreezeAfterEpisodeEnd

    env: gym.Env = BimanualEnv(task, **kwargs)
    if recordings["keep"] != "none":
        # Here and not above: LeRobot imports this module at each of its commands' start.
        from hdril.viewer.recorded_environment import RecordedEpisodes

        env = RecordedEpisodes(env, recordings["keep"], Path(recordings["folder"]))  # pyright: ignore
    return FreezeAfterEpisodeEnd(env)
