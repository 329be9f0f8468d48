"""What every registered task must keep: a new one is covered as soon as it is in ``TASKS``."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.rollout import transitions
from hdril.simulation.actions import hand_poses, hand_slice, openings
from hdril.simulation.kinematics import Chain
from hdril.simulation.robots import SIDES
from hdril.simulation.world import ROBOT, World
from hdril.tasks import TASKS, get_task
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.scenario import Scenario

pytestmark = pytest.mark.parametrize("task", TASKS)


@pytest.fixture
def env(task: str) -> Iterator[BimanualEnv]:
    made = BimanualEnv(task)
    with closing(made):
        yield made


def play(
    env: BimanualEnv,
    seed: int,
    idle: str | None = None,
    frames: int | None = None,
    scenario: Scenario | None = None,
) -> tuple[np.ndarray, dict]:
    """The expert's episode, in the scene of the seed or in ``scenario``; ``idle`` names a hand that stays where it is.

    States of the world, and the last info, which is of no success if the expert gave up.
    """
    expert = ScriptedExpert(env.task_spec)
    observation, info = env.reset(seed=seed, options=None if scenario is None else {"scenario": scenario})
    expert.reset(seed)
    rest = observation["agent_pos"].copy()
    states, done = [env.world.state_vector()], False
    while not done and env.frame != frames:
        try:
            action = expert.act(env.exact_observation()).action
        except StopIteration:
            break
        if idle is not None:
            action[hand_slice(idle)] = rest[hand_slice(idle)]
        _, _, terminated, truncated, info = env.step(action)
        states.append(env.world.state_vector())
        done = terminated or truncated
    return np.stack(states), info


def test_gymnasium_checker(env: BimanualEnv) -> None:
    check_env(env, skip_render_check=True)


def test_expert_succeeds(env: BimanualEnv) -> None:
    for seed in range(900_000, 900_004):
        _, info = play(env, seed)
        assert info["is_success"], (seed, info)
        longest = env.task_spec.horizon if env.task_spec.longest is None else env.task_spec.budget
        assert env.task_spec.horizon <= env.frame <= longest


def test_the_expert_reaches_the_stages_one_after_the_other(env: BimanualEnv) -> None:
    """A stage that never fails to hold, or that the expert never reaches, would tell nothing of a failure."""
    expert = ScriptedExpert(env.task_spec)
    reached = [transition.info["stage"] for transition in transitions(env, expert, 900_004)]
    assert reached == sorted(reached)
    assert reached[-1] == len(env.task_spec.stages) + 1, "success comes after the last one"
    assert env.task_spec.stages
    assert reached[0] < len(env.task_spec.stages)
    assert set(range(reached[0], reached[-1] + 1)) == set(reached)


@pytest.mark.long
def test_expert_succeeds_on_many_seeds(env: BimanualEnv) -> None:
    failures = [seed for seed in range(910_000, 910_200) if not play(env, seed)[1]["is_success"]]
    assert len(failures) <= 1, failures


@pytest.mark.parametrize("idle", SIDES)
def test_one_arm_fails(env: BimanualEnv, idle: str) -> None:
    for seed in range(920_000, 920_004):
        _, info = play(env, seed, idle=idle)
        assert not info["is_success"], f"seed {seed}: the {idle} hand is not needed"


def test_no_hands_fail(env: BimanualEnv) -> None:
    observation, _ = env.reset(seed=0)
    for _ in range(env.task_spec.horizon):
        _, _, _, _, info = env.step(observation["agent_pos"])
    assert not info["is_success"]


def test_same_seed_same_trajectory_bit_for_bit(env: BimanualEnv, task: str) -> None:
    """In a world that was used before, and in a new process."""
    first, _ = play(env, 7, frames=40)
    play(env, 8, frames=25)
    again, _ = play(env, 7, frames=40)
    assert first.tobytes() == again.tobytes()
    other, _ = play(env, 8, frames=2)
    assert other[-1].tobytes() != first[2].tobytes()
    program = (
        "import hashlib, sys; from tests.tasks.test_tasks import play; from hdril.env import BimanualEnv;"
        f"print(hashlib.sha256(play(BimanualEnv({task!r}), 7, frames=40)[0].tobytes()).hexdigest())"
    )
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed.split()[-1] == hashlib.sha256(first.tobytes()).hexdigest()


def test_nothing_is_moved_by_hand(env: BimanualEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    """During an episode the simulator is asked to step, to drive motors and to report: nothing else."""
    import pybullet

    env.reset(seed=3)
    calls = set()
    for name in dir(pybullet):
        function = getattr(pybullet, name)
        if callable(function) and not name.startswith("_") and not isinstance(function, type):

            def spy(*args, _name=name, _function=function, **kwargs):
                calls.add(_name)
                return _function(*args, **kwargs)

            monkeypatch.setattr(pybullet, name, spy)
    expert = ScriptedExpert(env.task_spec)
    expert.reset(3)
    observation = env._observe()
    done = False
    while not done:
        observation, _, terminated, truncated, _ = env.step(expert.act(observation).action)
        done = terminated or truncated
    moving = {name for name in calls if not name.startswith("get")}
    assert moving == {"stepSimulation", "setJointMotorControlArray"}


def test_nothing_can_be_added_or_reset_during_an_episode(env: BimanualEnv) -> None:
    observation, _ = env.reset(seed=0)
    env.step(observation["agent_pos"])
    with pytest.raises(RuntimeError, match="episode has begun"):
        env.world.reset_joints(ROBOT, ["left_s0"], [0.0])
    with pytest.raises(RuntimeError, match="episode has begun"):
        env.world.add_body(env.task_spec.bodies[0], Pose((0, 0, 0)))


def test_objects_start_where_the_task_says_and_at_rest(env: BimanualEnv) -> None:
    low = {name: np.full(3, np.inf) for name in env.task_spec.observed}
    high = {name: np.full(3, -np.inf) for name in env.task_spec.observed}
    for seed in range(30):
        env.reset(seed=seed)
        for name in env.task_spec.observed:
            position = env.world.pose(name).position
            placement = env.task_spec.placements[name]
            assert (position > np.array(placement.low) - 2e-3).all()
            assert (position < np.array(placement.high) + 2e-3).all()
            assert np.linalg.norm(env.world.velocity(name)[0]) < 5e-3
            low[name], high[name] = np.minimum(low[name], position), np.maximum(high[name], position)
    for name in env.task_spec.observed:
        placement = env.task_spec.placements[name]
        assert (high[name] - low[name])[:2] == pytest.approx(np.subtract(placement.high, placement.low)[:2], rel=0.4)


def test_labels_come_in_the_declared_order(env: BimanualEnv) -> None:
    expert = ScriptedExpert(env.task_spec)
    observation, _ = env.reset(seed=5)
    expert.reset(5)
    labels = []
    for _ in range(env.task_spec.horizon):
        step = expert.act(observation)
        assert step.explanation is not None
        labels.append(step.explanation.primitive)
        observation, *_ = env.step(step.action)
    names = [env.task_spec.labels[label] for label in labels]
    played = [p for p in env.task_spec.primitives if p.name in names]  # others may be superfluous in a scene
    assert names == [p.name for p in played for _ in range(p.frames)][: env.task_spec.horizon]


def test_gripper_opens_and_closes_in_the_action(env: BimanualEnv, task: str) -> None:
    expert = ScriptedExpert(get_task(task))
    observation, _ = env.reset(seed=1)
    expert.reset(1)
    actions = []
    for _ in range(env.task_spec.horizon):
        actions.append(expert.act(observation).action)
        observation, *_ = env.step(actions[-1])
    commanded = openings(np.stack(actions))
    assert (commanded.min(0) == 0.0).all()
    assert (commanded[0] == 1.0).all()


def test_the_arms_collide_with_each_other(env: BimanualEnv, task: str) -> None:
    """Hands that are sent to the same place push each other away."""
    observation, _ = env.reset(seed=0)
    action = observation["agent_pos"].copy()
    left, right = (action[hand_slice(side)][:3] for side in SIDES)  # views
    middle = 0.5 * (left + right)
    middle[2] += 0.15
    touched = False
    for _ in range(20):
        for position in (left, right):
            position += np.clip(middle - position, -0.04, 0.04)
        observation, *_ = env.step(action)
        touched |= bool(env.world.contacts(ROBOT, ROBOT))
    assert touched
    positions = hand_poses(observation["agent_pos"][None])[0, :, :3]
    assert np.linalg.norm(positions[0] - positions[1]) > 0.03


def test_an_arm_collides_with_the_torso(env: BimanualEnv) -> None:
    """An arm that is put into the torso is pushed out of it."""
    robot, torso = env.robot_spec, np.array([0.0, 0.0, 0.3])
    rng, arm = np.random.default_rng(0), env.robot_spec.arms["left"]
    chain = Chain(robot.source(), robot.base_link, arm.tool)
    candidates = (rng.uniform(chain.lower, chain.upper) for _ in range(20_000))
    q = next(q for q in candidates if np.abs(chain.forward(q).position - torso).max() < 0.12)
    with closing(World()) as world:
        world.add_urdf(ROBOT, robot.urdf(False), robot.base, self_collision=True)
        world.ignore_collisions(ROBOT, robot.ignored_collisions(world.links(ROBOT)))
        world.reset_joints(ROBOT, arm.joints, q.tolist())
        world.step()
        touching = {frozenset((contact.link_a, contact.link_b)) for contact in world.contacts(ROBOT, ROBOT)}
    assert any("base" in pair for pair in touching), touching


def test_pictures_show_the_scene(env: BimanualEnv) -> None:
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.std() > 10


def test_numpy_in_pybullet(task: str) -> None:
    import pybullet

    assert pybullet.isNumpyEnabled() == 1


def test_world_names_what_it_has(env: BimanualEnv) -> None:
    env.reset(seed=0)
    with pytest.raises(KeyError, match="no body 'chair'; bodies: robot"):
        env.world.pose("chair")
    with pytest.raises(KeyError, match="no joint 'knee'"):
        env.world.joint_indices(ROBOT, ["knee"])


def test_no_world_before_reset(task: str) -> None:
    with pytest.raises(RuntimeError, match="reset"):
        BimanualEnv(task).step(np.zeros(16) + 0.5)
