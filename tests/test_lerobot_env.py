"""The tasks in LeRobot's hands: registration, vector environments, and the same outcome however they are batched."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot_policy_hdril import HDRILConfig

from hdril.env import BimanualEnv
from hdril.lerobot_env import HDRILEnvConfig
from hdril.simulation.actions import hand_slice
from hdril.simulation.robots import SIDES
from hdril.tasks import TASKS, get_task
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise


class Scripted(PreTrainedPolicy):
    """The expert as a LeRobot policy, from observations alone. It never closes its hands on what starts far off."""

    config_class: Any = HDRILConfig
    name: Any = "scripted"

    def __init__(self, task: str) -> None:
        super().__init__(HDRILConfig(device="cpu", push_to_hub=False))
        self.task = get_task(task)
        placement = self.task.placements[self.task.observed[0]]
        self.middle = 0.5 * (placement.low[0] + placement.high[0])
        self.dummy = torch.nn.Parameter(torch.zeros(1))
        self.experts: list[tuple[ScriptedExpert, bool]] = []

    def reset(self) -> None:
        self.experts = []

    def select_action(self, batch, **kwargs) -> torch.Tensor:
        states, objects = batch["observation.state"].numpy(), batch["observation.environment_state"].numpy()
        if not self.experts:
            self.experts = [(ScriptedExpert(self.task, Noise(0.0)), row[0] > self.middle) for row in objects]
        actions = []
        for (expert, spoiled), state, row in zip(self.experts, states, objects, strict=True):
            action = expert.act({"agent_pos": state, "environment_state": row}).action
            if spoiled:
                action[[hand_slice(side).stop - 1 for side in SIDES]] = 1.0  # open hands
            actions.append(torch.from_numpy(action))
        return torch.stack(actions).float()

    def forward(self, batch):
        raise RuntimeError("not for training")

    def get_optim_params(self):
        return self.parameters()

    def predict_action_chunk(self, batch, **kwargs):
        return self.select_action(batch)[:, None]


def outcomes(task: str, n_envs: int, use_async: bool, episodes: int, **options) -> dict[int, bool]:
    """Success by seed, from LeRobot's own evaluation loop."""
    vector = make_env(HDRILEnvConfig(task=task, **options), n_envs=n_envs, use_async_envs=use_async)["hdril"][0]
    around_env = [PolicyProcessorPipeline(steps=[]) for _ in range(2)]
    around_policy = [lambda data: data] * 2
    with closing(vector):
        info = eval_policy(vector, Scripted(task), *around_env, *around_policy, n_episodes=episodes, start_seed=930_000)
    return {row["seed"]: row["success"] for row in info["per_episode"]}


@pytest.mark.parametrize(
    "task", [task if task == "table_lift" else pytest.param(task, marks=pytest.mark.long) for task in TASKS]
)
def test_same_outcomes_for_one_several_and_asynchronous_environments(task: str) -> None:
    one = outcomes(task, 1, False, 6)
    assert set(one.values()) == {True, False}, "the seeds should hold both outcomes"
    assert outcomes(task, 3, False, 6) == one
    assert outcomes(task, 2, True, 6) == one


@pytest.mark.parametrize(("rerun", "kept"), [("failures", {False}), ("all", {True, False})])
def test_environments_write_recordings(rerun: str, kept: set[bool], tmp_path: Path) -> None:
    """One file for every episode that is to be kept, named by its seed and outcome, and no other."""
    options = {"rerun": rerun, "rerun_dir": str(tmp_path / "rerun")}
    found = outcomes("table_lift", 2, rerun == "all", 4, **options)
    assert set(found.values()) == {True, False}
    words = {True: "success", False: "failure"}
    names = {f"seed_{seed:07d}_{words[success]}.rrd" for seed, success in found.items() if success in kept}
    files = list((tmp_path / "rerun").iterdir())
    assert {file.name for file in files} == names
    for file in files:
        assert 100_000 < file.stat().st_size < 2_000_000


def test_unknown_choice_of_recordings_is_named() -> None:
    with pytest.raises(ValueError, match=r"env\.rerun must be failures, all, none or a number, got 'some'"):
        make_env(HDRILEnvConfig(task="table_lift", rerun="some"))


@pytest.mark.parametrize("task", TASKS)
def test_gym_id_makes_the_task(task: str) -> None:
    env = gym.make(get_task(task).gym_id, disable_env_checker=True)
    assert isinstance(env.unwrapped, BimanualEnv)
    assert env.unwrapped.task == task
    env.close()


def test_types_are_registered() -> None:
    assert EnvConfig.get_choice_class("hdril") is HDRILEnvConfig
    assert PreTrainedConfig.get_choice_class("hdril") is HDRILConfig


def test_unknown_task_is_named() -> None:
    with pytest.raises(ValueError, match=r"unknown task 'chess'; choose from: .*table_lift"):
        make_env(HDRILEnvConfig(task="chess"))


def test_unknown_robot_is_named() -> None:
    with pytest.raises(ValueError, match=r"^unknown robot 'hal'; choose from: baxter"):
        make_env(HDRILEnvConfig(robot="hal"), n_envs=2, use_async_envs=True)


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_shorter_than_the_horizon_is_refused_before_a_worker_starts(task: str) -> None:
    horizon = get_task(task).horizon
    with pytest.raises(ValueError, match=rf"^env\.episode_length must be at least {horizon}, got {horizon - 1}: "):
        make_env(HDRILEnvConfig(task=task, episode_length=horizon - 1), n_envs=2, use_async_envs=True)
    vector = make_env(HDRILEnvConfig(task=task, episode_length=horizon + 5), n_envs=1)["hdril"][0]
    with closing(vector):
        assert vector.call("_max_episode_steps") == (horizon + 5,)


def test_videos_can_be_drawn() -> None:
    vector = make_env(HDRILEnvConfig(task="table_lift"), n_envs=1)["hdril"][0]
    with closing(vector):
        vector.reset(seed=[0])
        (frame,) = vector.call("render")
        assert np.asarray(frame).shape == (240, 320, 3)
