"""gym-aloha's simulation by poses, its experts, and the recorder. Needs the extra ``aloha``."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.envs.factory import make_env

from hdril.aloha import record as recording
from hdril.aloha.env import AlohaPosesEnv
from hdril.aloha.expert import demonstrate
from hdril.aloha.lerobot_env import AlohaPosesConfig
from hdril.aloha.record import record
from hdril.aloha.tasks import STARTS, TASKS, AlohaTask
from hdril.demonstrations.check import check_dataset
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.read import read_episode
from hdril.demonstrations.record import ExpertError
from hdril.geometry import geodesic_distance
from hdril.simulation.actions import ACTION_NAMES, hand_poses
from hdril.simulation.robots.spec import SIDES

pytestmark = pytest.mark.skipif(find_spec("gym_aloha") is None, reason="needs gym-aloha, the extra aloha")
each_task = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)


@cache
def env_of(task: str) -> AlohaPosesEnv:
    return AlohaPosesEnv(task)


def still(opening: float = 0.0) -> np.ndarray:
    """(16,): the hands where they are told to be at first."""
    return np.concatenate([[*STARTS[side], 0.0, 0.0, 0.0, 1.0, opening] for side in SIDES])


@each_task
def test_a_seed_is_an_episode_bit_for_bit(task: AlohaTask) -> None:
    first = demonstrate(env_of(task.name), 7)
    demonstrate(env_of(task.name), 8)
    for again in (demonstrate(env_of(task.name), 7), demonstrate(AlohaPosesEnv(task.name), 7)):
        for name in ("state", "environment_state", "action", "reward"):
            np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    assert not np.array_equal(demonstrate(env_of(task.name), 8).environment_state, first.environment_state)


@each_task
def test_the_scene_of_a_seed_is_that_of_gym_aloha(task: AlohaTask) -> None:
    observation, info = env_of(task.name).reset(seed=11)
    theirs = np.reshape(getattr(import_module("gym_aloha.utils"), task.places)(11), (-1, 7))
    ours = observation["environment_state"].reshape(-1, 7)
    np.testing.assert_allclose(ours, theirs[:, [0, 1, 2, 4, 5, 6, 3]], atol=1e-7)
    assert info == {"is_success": False}


def test_hands_are_measured_in_the_frames_that_are_commanded() -> None:
    """Each hand reaches a pose that is turned about all three axes, from 13 cm away."""
    env = env_of("transfer_cube")
    env.reset(seed=0)
    target = [0.2, 0.45, 0.25, 0.1, -0.3, 0.2, 0.927]
    action = np.concatenate([[-target[0], *target[1:], 1.0], [*target, 0.0]])
    for _ in range(30):
        observation, *_ = env.step(action)
    for told, measured in zip(hand_poses(action[None])[0], hand_poses(observation["agent_pos"][None])[0], strict=True):
        assert np.linalg.norm(told[:3] - measured[:3]) < 0.01
        assert np.degrees(geodesic_distance(told[3:], measured[3:])) < 2.0


def test_a_command_is_reached_in_five_even_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    env, sent = env_of("transfer_cube"), []
    env.reset(seed=0)
    env.step(still())
    monkeypatch.setattr(env._physics, "step", lambda commands: sent.append(commands) or 0)
    action = still(1.0)
    action[0] += 0.05
    env.step(action)
    x = [commands["left"].pose.position[0] - STARTS["left"][0] for commands in sent]
    np.testing.assert_allclose(x, [0.01, 0.02, 0.03, 0.04, 0.05])
    np.testing.assert_allclose([commands["right"].opening for commands in sent], [0.2, 0.4, 0.6, 0.8, 1.0])


@pytest.mark.parametrize(("rewards", "success"), [((0, 3, 3), False), ((0, 4, 1), True)])
def test_success_is_their_highest_reward_at_any_step(
    rewards: tuple[int, ...], success: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, given = env_of("insertion"), iter([*rewards, *[0] * 397])
    env.reset(seed=0)
    monkeypatch.setattr(env._physics, "step", lambda commands: next(given))
    over, frames, total = False, 0, []
    while not over:
        _, reward, terminated, over, info = env.step(still())
        frames, total = frames + 1, [*total, reward]
        assert not terminated
        assert info["is_success"] == success
    assert frames == 80
    assert total == [max(rewards), *[0.0] * 79]


def test_doing_nothing_is_no_success() -> None:
    env = env_of("transfer_cube")
    env.reset(seed=0)
    assert not any(env.step(still())[-1]["is_success"] for _ in range(80))


def test_an_action_that_is_not_finite_is_refused() -> None:
    env = env_of("transfer_cube")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"left_gripper\.pos = nan"):
        env.step(np.where(np.arange(16) == 7, np.nan, still()))


@each_task
def test_the_expert_succeeds_and_what_it_holds_stays_held(task: AlohaTask) -> None:
    episodes = [demonstrate(env_of(task.name), seed) for seed in range(20)]
    won = [episode for episode in episodes if episode.success]
    assert len(won) >= 19
    assert all(episode.reward[-1] == 4 for episode in won)
    assert all(episode.reward.max() < 4 and "not 4" in episode.unmet for episode in episodes if not episode.success)


@each_task
def test_a_recorded_dataset_holds_the_episodes_and_nothing_is_wrong_with_it(task: AlohaTask, tmp_path: Path) -> None:
    root = tmp_path / "set"
    made = record(task, 2, 40, root)
    assert made.kept == [40, 41]
    assert list(check_dataset(root)) == []
    for index, seed in enumerate(made.kept):
        episode, stored = demonstrate(env_of(task.name), seed), read_episode(root, index)
        assert stored.label is not None
        assert stored.label.tolist() == episode.label.tolist()
        assert stored.primitives == task.labels
        assert stored.signals["action"].names == ACTION_NAMES
        np.testing.assert_array_equal(stored.action, episode.action)
        np.testing.assert_array_equal(stored.signals["observation.environment_state"].values, episode.environment_state)
        assert stored.signals["observation.environment_state"].names == task.state_names
    rows = pd.read_parquet(root / "meta/episodes")
    assert rows["seed"].tolist() == [40, 41]
    frame = LeRobotDataset("local/aloha", root=root)[79]
    assert frame["next.success"].item()
    assert frame["next.reward"].item() == 4
    assert frame["task"] == task.description
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def _failing(every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every so manieth demonstration fail."""
    episode = demonstrate(env_of("transfer_cube"), 0)

    def play(env: AlohaPosesEnv, seed: int) -> Episode:
        fails = seed % every == 0
        return replace(episode, seed=seed, success=not fails, unmet="it fell" if fails else "")

    monkeypatch.setattr(recording, "demonstrate", play)


def test_a_failure_is_dropped_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _failing(2, monkeypatch)
    made = record(TASKS["transfer_cube"], 2, 4, tmp_path / "set")
    assert made.kept == [5, 7]
    assert made.dropped == {4: "it fell", 6: "it fell"}
    assert pd.read_parquet(tmp_path / "set/meta/episodes")["seed"].tolist() == [5, 7]


def test_an_expert_that_only_fails_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _failing(1, monkeypatch)
    with pytest.raises(ExpertError, match="last: it fell"):
        record(TASKS["transfer_cube"], 2, 0, tmp_path / "set")
    assert not list(tmp_path.iterdir())


def test_nothing_is_left_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = recording.write_episodes

    def late(root: Path, *rest) -> None:
        write(root, *rest)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recording, "write_episodes", late)
    with pytest.raises(OSError, match="No space left"):
        record(TASKS["transfer_cube"], 1, 0, tmp_path / "set")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("use_async", [False, True])
def test_lerobot_makes_the_environment(use_async: bool) -> None:
    vector = make_env(AlohaPosesConfig(task="insertion"), n_envs=2, use_async_envs=use_async)["aloha_poses"][0]
    observation, _ = vector.reset(seed=[3, 4])
    assert observation["agent_pos"].shape == (2, 16)
    for row, seed in zip(observation["environment_state"], (3, 4), strict=True):
        np.testing.assert_array_equal(row, env_of("insertion").reset(seed=seed)[0]["environment_state"])
    assert vector.call("_max_episode_steps") == (80, 80)
    vector.close()


def test_without_drawing_the_picture_is_black(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    env = env_of("transfer_cube")
    env.reset(seed=0)
    assert env.render().shape == (240, 320, 3)
    assert not env.render().any()
