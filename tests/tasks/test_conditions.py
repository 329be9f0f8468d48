"""Every condition from both sides of its threshold, and every success condition of every task by its negation."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.world import ROBOT, Physics, World
from hdril.tasks import TASKS, conditions
from hdril.tasks.conditions import Condition, failed
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.trace import trace_episode

BLOCK = BodySpec("block", (Box((0.2, 0.2, 0.2), (0.0, 0.0, 0.1)),), mass=1.0)
FLOOR = BodySpec("floor", (Box((1.0, 1.0, 0.1), (0.0, 0.0, -0.05)),))


def scene(position=(0.0, 0.0, 0.0), tilt: float = 0.0, gravity: float = 0.0, axis: str = "x") -> World:
    """A block whose foot is at ``position`` over a floor, one timestep after it was put there."""
    world = World(Physics(gravity=gravity))
    world.add_body(FLOOR, Pose((0.0, 0.0, 0.0)))
    world.add_body(BLOCK, Pose(position, Rotation.from_euler(axis, tilt).as_quat()))
    world.step()
    return world


def speed(metres_per_second: float) -> Callable[[], World]:
    """A block that falls at this speed after its first timestep."""
    return lambda: scene((0.0, 0.0, 1.0), gravity=240.0 * metres_per_second)


def at(*position: float) -> Callable[[], World]:
    return lambda: scene(position)


def tilted(cosine: float, axis: str = "x") -> Callable[[], World]:
    return lambda: scene((0.0, 0.0, 1.0), float(np.arccos(cosine)), axis=axis)


C = conditions
THRESHOLDS: list[tuple[Condition, str, list[Callable[[], World]], list[Callable[[], World]]]] = [
    (C.upright("block"), "block upright", [tilted(0.9905), tilted(0.9905, "y"), tilted(1.0)],
     [tilted(0.9895), tilted(0.9895, "y"), tilted(-0.999)]),
    (C.upright("block", 0.5), "block upright", [tilted(0.51)], [tilted(0.49)]),
    (C.at_rest("block"), "block at rest", [speed(0.0099), speed(0.0)], [speed(0.0101)]),
    (C.at_rest("block", 0.5), "block at rest", [speed(0.49)], [speed(0.51)]),
    (C.at_height("block", 0.3), "block at height 0.3 m", [at(0.4, 0.4, 0.3095), at(0, 0, 0.2905)],
     [at(0, 0, 0.3105), at(0, 0, 0.2895)]),
    (C.at_height("block", 0.3, 0.1), "block at height 0.3 m", [at(0, 0, 0.399)], [at(0, 0, 0.401), at(0, 0, 0.199)]),
    (C.touching("block", "floor"), "block on floor", [at(0, 0, -0.001)], [at(0, 0, 0.01), at(2, 0, -0.001)]),
    (C.not_touching("block", "floor"), "block free of floor", [at(0, 0, 0.01), at(2, 0, 0)], [at(0, 0, -0.001)]),
    (C.lies_at("block", "x", 0.3), "block at x = 0.3 m", [at(0.3095, 1, 1), at(0.2905, 1, 1)],
     [at(0.3105, 0.3, 0.3), at(0.2895, 0.3, 0.3)]),
    (C.lies_at("block", "y", -0.3, 0.05), "block at y = -0.3 m", [at(1, -0.349, 1)], [at(-0.3, -0.351, -0.3)]),
    (C.lies_at("block", "z", 0.4), "block at z = 0.4 m", [at(1, 1, 0.4095)], [at(0.4, 0.4, 0.4105)]),
    (C.raised("block", 0.25), "block raised by 0.25 m", [at(0, 0, 0.2505), at(0, 0, 2)], [at(0, 0, 0.2495)]),
]  # fmt: skip


@pytest.mark.parametrize(
    ("condition", "name", "inside", "outside"),
    THRESHOLDS,
    ids=[str(i) + " " + row[1] for i, row in enumerate(THRESHOLDS)],
)
def test_a_condition_holds_up_to_its_threshold(condition: Condition, name: str, inside, outside) -> None:
    assert condition.name == name
    for make, expected in [(make, True) for make in inside] + [(make, False) for make in outside]:
        with closing(make()) as world:
            assert condition.holds(world) is expected
            assert failed((condition,), world) == (() if expected else (name,))


def test_every_constructor_has_its_thresholds_tested() -> None:
    constructors = {
        function for name, function in inspect.getmembers(conditions, inspect.isfunction)
        if inspect.get_annotations(function).get("return") == "Condition"
    }  # fmt: skip
    assert {function.__name__ for function in constructors} >= {"upright", "touching"}
    built = {condition.holds.__qualname__.partition(".")[0] for condition, *_ in THRESHOLDS}
    assert {function.__name__ for function in constructors} == built


def test_failed_names_what_fails_in_order() -> None:
    yes, no, other = (Condition(name, lambda world, v=value: v) for name, value in
                      (("yes", True), ("no", False), ("other", False)))  # fmt: skip
    with closing(scene()) as world:
        assert failed((other, yes, no), world) == ("other", "no")
        assert failed((), world) == ()


# ---------------------------------------------------------------------- success by its negation

SHIFTS = (0.003, 0.006, 0.012, 0.02, 0.03, 0.06, 0.1, 0.2)
LEVELS = sorted(np.arange(-0.3, 0.31, 0.01), key=abs)
TILTS = tuple(np.deg2rad((3.0, 5.0, 7.0, 9.0, 12.0)))
SPEEDS = (0.005, 0.02, 0.1, 0.5)


class Disturbed:
    """The world after an expert's success. Bodies and arms are put elsewhere by hand, which an episode never does."""

    def __init__(self, env: BimanualEnv, postures: np.ndarray) -> None:
        self.env, self.world, self.postures = env, env.world, postures
        self.bodies = env.task_spec.observed
        self.poses = {name: self.world.pose(name) for name in self.bodies}
        self.joints = self.world.joint_indices(ROBOT, env.controller.joint_names)

    def put(self, poses: dict[str, Pose], speeds: dict[str, np.ndarray], posture: np.ndarray | None) -> None:
        """Bodies that are not named are where they were, at rest; the arms too."""
        world = self.world
        for name in self.bodies:
            base = poses.get(name, self.poses[name]) @ world._body_frames[name].inverse()
            world._call("resetBasePositionAndOrientation", world._ids[name], base.position, base.quaternion)
            world._call("resetBaseVelocity", world._ids[name], speeds.get(name, np.zeros(3)), [0.0] * 3)
        for joint, angle in zip(self.joints, self.postures[-1] if posture is None else posture, strict=True):
            world._call("resetJointState", world._ids[ROBOT], joint, angle)
        world._call("performCollisionDetection")
        world._poses.clear()  # as a step does

    def disturbances(self) -> Iterator[tuple[dict[str, Pose], dict[str, np.ndarray], np.ndarray | None]]:
        """Arms as they were at another frame; bodies pushed, moved or tilted, one by one or, to another level, together."""
        yield {}, {}, None
        yield from (({}, {}, posture) for posture in self.postures[::-2])
        for name, size, axis in itertools.product(self.bodies, SPEEDS, np.eye(3)):
            yield {}, {name: size * axis}, None
        for level in LEVELS:
            together = {name: pose.translated((0.0, 0.0, level)) for name, pose in self.poses.items()}
            yield together, {}, None
            for name, size, axis in itertools.product(self.bodies, SHIFTS, (*np.eye(3), *-np.eye(3))):
                yield together | {name: together[name].translated(size * axis)}, {}, None
            for name, angle, axis in itertools.product(self.bodies, TILTS, (*np.eye(3), *-np.eye(3))):
                turn = Pose((0.0, 0.0, 0.0), Rotation.from_rotvec(angle * axis).as_quat())
                yield together | {name: together[name] @ turn}, {}, None


def successful(task: str) -> Disturbed:
    """The world in which an expert has just succeeded."""
    env = BimanualEnv(task)
    trace, ending = trace_episode(env, ScriptedExpert(env.task_spec, Noise(0.0)), 960_000)
    assert ending.success
    return Disturbed(env, trace.joints)


@pytest.mark.parametrize("task", [*TASKS, *(f"{task}:level=varied" for task in TASKS), "handover:upright=1"])
def test_an_episode_fails_by_each_success_condition_alone(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """For each condition there is a world in which it alone fails; the environment judges it a failure and says which."""
    disturbed = successful(task)
    with closing(disturbed.env) as env:
        monkeypatch.setattr(env.controller, "apply", lambda commands: None)  # judge the world as it was put
        action = env.controller.observe()
        disturbed.put({}, {}, None)
        env.frame = env.task_spec.horizon - 1
        _, reward, terminated, _, info = env.step(action)
        assert (reward, terminated, info["is_success"], info["unmet"]) == (1.0, True, True, "")
        missing = {condition.name for condition in env.task_spec.success}
        for disturbance in disturbed.disturbances():
            disturbed.put(*disturbance)
            unmet = failed(env.task_spec.success, env.world)
            if len(unmet) == 1 and unmet[0] in missing:
                _, reward, terminated, _, info = env.step(action)
                assert (reward, terminated, info["is_success"], info["unmet"]) == (0.0, False, False, unmet[0])
                missing.remove(unmet[0])
            if not missing:
                break
        assert not missing, "no disturbance of the world makes this fail alone"
