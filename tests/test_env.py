"""The environment's budget of frames, its gym ids, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import hdril
from hdril.actor import Decision, Observation
from hdril.env import START_CLEARANCE, BimanualEnv
from hdril.rollout import run_episode
from hdril.simulation import world
from hdril.simulation.robots import ROBOTS
from hdril.simulation.world import ROBOT, World
from hdril.tasks import TASKS, get_task
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise

tasks = pytest.mark.parametrize("task", TASKS)


class LateExpert:
    """Keeps still for a while, and then does what the expert does."""

    def __init__(self, expert: ScriptedExpert, delay: int) -> None:
        self._expert, self._delay = expert, delay

    def reset(self, seed: int) -> None:
        self._expert.reset(seed)
        self._frame = 0

    def act(self, observation: Observation) -> Decision:
        self._frame += 1
        return Decision(observation["agent_pos"]) if self._frame <= self._delay else self._expert.act(observation)


@tasks
def test_an_episode_shorter_than_its_horizon_is_refused(task: str) -> None:
    horizon = get_task(task).horizon
    for frames in (0, 1, horizon - 1):
        with pytest.raises(
            ValueError, match=f"^max_episode_steps must be at least {horizon}, got {frames}: the success of"
        ):
            BimanualEnv(task, max_episode_steps=frames)
    assert BimanualEnv(task, max_episode_steps=horizon)._max_episode_steps == horizon
    assert BimanualEnv(task)._max_episode_steps == get_task(task).budget >= horizon


@tasks
def test_a_longer_episode_may_succeed_after_the_horizon(task: str) -> None:
    horizon, delay, longest = get_task(task).horizon, 20, get_task(task).budget
    for budget, success in ((horizon, False), (longest + horizon, True)):
        env = BimanualEnv(task, max_episode_steps=budget)
        with closing(env):
            expert = LateExpert(ScriptedExpert(env.task_spec, Noise(0.0)), delay)
            ending = run_episode(env, expert, 970_000)
        assert ending.success is success, ending
        assert (
            horizon < ending.frames <= longest + delay + get_task(task).dwell if success else ending.frames == horizon
        )


@tasks
def test_an_episode_without_success_ends_with_its_budget(task: str) -> None:
    horizon = get_task(task).horizon
    env = BimanualEnv(task, max_episode_steps=horizon + 2)
    with closing(env):
        observation, _ = env.reset(seed=0)
        for frame in range(1, horizon + 3):
            _, reward, terminated, truncated, info = env.step(observation["agent_pos"])
            assert (reward, terminated, truncated) == (0.0, False, frame == horizon + 2)
            assert (info["unmet"] == "the primitives are not over") == (frame < horizon)


@tasks
def test_an_episode_ends_when_an_object_has_fallen_off_the_bench_and_says_which(task: str) -> None:
    scenario = get_task(task).sample(0)
    lost = get_task(task).observed[0]
    beside = (0.6, 3.0, *scenario.poses[lost][2:])
    with closing(BimanualEnv(task)) as env:
        observation, _ = env.reset(options={"scenario": replace(scenario, poses=scenario.poses | {lost: beside})})
        info, truncated, terminated = {"unmet": ""}, False, False
        while not truncated:
            assert "fallen" not in info["unmet"]
            _, _, terminated, truncated, info = env.step(observation["agent_pos"])
        assert env.frame < 15
        assert not terminated
        assert info["unmet"].split(", ")[-1] == f"{lost} has fallen off the bench"


def test_gymnasium_knows_every_task_after_import_hdril() -> None:
    """In a new process, which imports nothing else of hdril; and importing LeRobot's side registers nothing again."""
    program = (
        "import hdril, gymnasium;"
        f"envs = [gymnasium.make(id, disable_env_checker=True) for id in {[get_task(task).gym_id for task in TASKS]}];"
        "print(*(env.unwrapped.task for env in envs));"
        "before = dict(gymnasium.registry); import hdril.lerobot_env; print(before == dict(gymnasium.registry))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split()[-len(TASKS) - 1 :] == [*TASKS, "True"]


def test_ids_follow_from_names() -> None:
    assert get_task("table_lift").gym_id == "hdril/TableLift-v0"
    assert get_task("peg_in_hole").gym_id == "hdril/PegInHole-v0"
    assert get_task("peg_in_hole:clearance=0.008").gym_id == "hdril/PegInHole-v0"
    assert {get_task(task).gym_id for task in TASKS} == {id for id in gym.registry if id.startswith("hdril/")}


def test_the_version_is_that_of_the_distribution() -> None:
    from importlib.metadata import version

    assert hdril.__version__ == version("hdril")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "chess"}, rf"^unknown task 'chess'; choose from: {', '.join(TASKS)}$"),
        ({"robot": "hal"}, rf"^unknown robot 'hal'; choose from: {', '.join(ROBOTS)}$"),
        ({"render_mode": "human"}, "^unknown render mode 'human'; choose from: rgb_array$"),
    ],
)
def test_unknown_names_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BimanualEnv(**options)


def test_an_action_that_is_not_finite_moves_nothing() -> None:
    env = BimanualEnv()
    with closing(env):
        observation, _ = env.reset(seed=0)
        before = env.world.state_vector()
        with pytest.raises(ValueError, match="not finite"):
            env.step(np.full_like(observation["agent_pos"], np.nan))
        assert env.frame == 0
        np.testing.assert_array_equal(env.world.state_vector(), before)


def test_closing_goes_on_after_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while the simulator is given back: the command closes the environment again, and must end as interrupted."""
    env = BimanualEnv("table_lift")
    env.reset(seed=0)
    empty = world.bullet.resetSimulation

    def interrupted(physicsClientId: int) -> None:  # noqa: N803  # the simulator's name
        empty(physicsClientId=physicsClientId)
        raise KeyboardInterrupt

    monkeypatch.setattr(world.bullet, "resetSimulation", interrupted)
    monkeypatch.setattr(world, "_idle", [])
    with pytest.raises(KeyboardInterrupt):
        env.close()
    env.close()
    assert not world._idle


@pytest.mark.parametrize(
    ("task", "seed"), [("peg_in_hole", 932_007), ("table_lift", 932_000), ("clear_and_lift", 932_003)]
)
def test_arms_do_not_start_at_an_object(task: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In these scenes they would: the first posture that is drawn is not the one that is taken."""
    with closing(BimanualEnv(f"{task}:posture=0.1")) as env:
        tried: list[bool] = []
        start = env.controller.start

        def watched(scene: World, offsets: dict[str, float] | None = None) -> None:
            start(scene, offsets)
            movable = [body.name for body in env.task_spec.bodies if body.mass > 0.0]
            tried.append(any(scene.near(ROBOT, name, START_CLEARANCE) for name in movable))

        monkeypatch.setattr(env.controller, "start", watched)
        env.reset(seed=seed)
        assert tried == [True, False]


def test_an_exact_observation_needs_an_episode() -> None:
    with pytest.raises(RuntimeError, match="no episode is running"):
        BimanualEnv("table_lift").exact_observation()
