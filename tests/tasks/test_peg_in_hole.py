"""What is particular to peg-in-hole: the halves need each other, and half a connection does not count."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.rollout import transitions
from hdril.tasks import get_task, half_tables, joining
from hdril.tasks.events import Event
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.footprint import apart
from hdril.tasks.half_tables import LEFT, RIGHT, SIGN
from hdril.tasks.peg_in_hole import gap, insertion, make_task
from hdril.tasks.primitives import Noise, Primitive, carry_each, lift_joined, lower, reach

TASK = get_task("peg_in_hole")


def play(seed: int, script: tuple[Primitive, ...], name: str = TASK.name) -> tuple[dict, list[dict], dict[str, Pose]]:
    """Last info, all infos and the poses at the end, of ``script`` on the scene of ``seed``."""
    env = BimanualEnv(name)
    expert = ScriptedExpert(replace(env.task_spec, primitives=script), Noise(0.0))
    infos = []
    with closing(env):
        observation, info = env.reset(seed=seed)
        expert.reset(seed)
        infos.append(info)
        for _ in range(sum(primitive.frames for primitive in script)):
            observation, _, _, _, info = env.step(expert.act(observation).action)
            infos.append(info)
        poses = {half: env.world.pose(half) for half in (LEFT, RIGHT)}
        assert gap(env.world) == pytest.approx(info["gap_mm"] / 1e3)
        assert insertion(env.world) == pytest.approx(info["insertion_mm"] / 1e3)
    return info, infos, poses


@pytest.mark.parametrize("handle", [1.0, -1.0], ids=["outer", "inner"])
def test_unconnected_halves_cannot_be_lifted_level(handle: float) -> None:
    """Each hand lifts the half on its side by one of its handles, where it stands."""
    held = {"left": LEFT, "right": RIGHT}
    grips = {side: joining.grip_on(half, side, handle * SIGN[half]) for side, half in held.items()}
    for seed in range(950_000, 950_020):
        info, _, poses = play(seed, (reach("reach", grips), lower("grasp", grips), lift_joined("lift", squeeze=0.0)))
        assert not info["is_success"]
        for half, pose in poses.items():
            tilt = np.rad2deg(np.arccos(pose.rotation_matrix()[2, 2]))
            assert tilt > 10.0, f"seed {seed}: {half} hangs by {tilt:.1f} degrees and is {pose.position[2]:.3f} m high"
            assert pose.position[2] > 0.02, f"seed {seed}: {half} was not lifted at all"


def test_a_peg_that_is_half_inserted_fails() -> None:
    held = {"left": LEFT, "right": RIGHT}
    wide = joining.squared_at(lambda scene, half: SIGN[half] * (half_tables.WIDTH / 2 + 0.02), LEFT, RIGHT)
    stop = carry_each("connect", held, wide, 10)
    for seed in range(951_000, 951_003):
        info, infos, _ = play(seed, (*TASK.primitives[:-2], stop, lift_joined(frames=10)))
        assert not info["is_success"]
        assert "gap" in info["unmet"]
        assert info["stage"] == [stage.name for stage in TASK.stages].index("peg in the hole") + 1
        assert max(row["insertion_mm"] for row in infos) > 50.0


def test_stages_and_measures_follow_the_expert() -> None:
    info, infos, _ = play(952_000, TASK.primitives)
    assert info["is_success"]
    stages = [row["stage"] for row in infos]
    assert stages == sorted(stages)
    assert stages[0] == 0
    assert stages[-1] == len(TASK.stages) + 1
    reached = [stages.index(i + 1) for i in range(len(TASK.stages))]
    ends = np.cumsum([primitive.frames for primitive in TASK.primitives])
    names = [primitive.name for primitive in TASK.primitives]
    for frame, name in zip(reached, ("move_left", "move_right", "connect", "connect"), strict=True):
        start = ends[names.index(name)] - 10
        assert start < frame <= start + 10, (frame, name)
    assert infos[-1]["gap_mm"] < 5.0
    assert infos[-1]["insertion_mm"] > 90.0
    assert infos[0]["insertion_mm"] == 0.0


@pytest.mark.parametrize("name", ["peg_in_hole:clearance=0.008", "peg_in_hole:clearance=0.004,chamfer=0.02"])
def test_clearance_and_chamfer_can_be_set_with_the_name(name: str) -> None:
    task = get_task(name)
    assert task.name == name
    assert task.bodies != TASK.bodies
    info, _, _ = play(953_000, task.primitives, name)
    assert info["is_success"]


def test_hole_is_wider_than_the_peg_by_the_clearance() -> None:
    for clearance in (0.002, 0.005):
        peg = make_task(clearance).bodies[1].boxes[-1]
        boxes = make_task(clearance).bodies[2].boxes
        cheeks = [box for box in boxes if box.size[2] == pytest.approx(peg.size[2] + 2 * clearance)]
        assert len(cheeks) == 2
        for cheek in cheeks:
            assert abs(cheek.centre[0]) - cheek.size[0] / 2 == pytest.approx(peg.size[0] / 2 + clearance)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("peg_in_hole:width=1", "has no parameter 'width'; it has: level, clearance, chamfer, "),
        ("peg_in_hole:clearance=wide", "clearance must be a number, got 'wide'"),
        ("peg_in_hole:clearance=0.5", "clearance must be from 0.0005 to 0.02 m, got 0.5"),
        ("peg_in_hole:chamfer=-1", "chamfer must be from 0 to 0.03 m, got -1"),
        ("table_lift:clearance=0.005", "table_lift has no parameter 'clearance'; it has: level, yaw, "),
    ],
)
def test_parameters_are_checked(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        get_task(name)


def test_each_half_has_its_own_size_mass_and_heading() -> None:
    values = {
        "size:left_half.length": 0.9,
        "size:right_half.depth": 1.1,
        "mass:right_half": 2.0,
        "yaw:left_half": 20.0,
        "hole": 0.6,
    }
    scene, before = TASK.at(values), dict(TASK.attributes)
    after = dict(scene.attributes)
    assert after["left_half.length"] == pytest.approx(0.9 * before["left_half.length"])
    assert after["right_half.depth"] == pytest.approx(1.1 * before["right_half.depth"])
    assert {name for name in after if after[name] != before[name]} == {"left_half.length", "right_half.depth"}
    left, right = scene.bodies[1:]
    assert (left.mass, right.mass) == (2.0, 4.0)
    assert left.boxes[-1].size == TASK.bodies[1].boxes[-1].size  # the peg does not grow
    assert scene.placements[LEFT].yaw == pytest.approx(np.deg2rad(20.0))
    assert scene.placements[RIGHT].yaw == 0.0
    assert right.boxes == make_task(0.003).at(values | {"hole": 1.0}).bodies[2].boxes


@pytest.mark.parametrize("half", [LEFT, RIGHT])
@pytest.mark.parametrize("scale", [0.85, 1.15])
def test_gap_and_insertion_know_the_size_of_the_halves(half: str, scale: float) -> None:
    """The faces touch and the peg is in to its root, for a half of any length."""
    scene = TASK.at({f"size:{half}.length": scale})
    lengths = dict(scene.attributes)
    widths = (lengths["left_half.length"], lengths["right_half.length"])
    poses = Pose((0.6, widths[0] / 2, 0.0)), Pose((0.6, -widths[1] / 2, 0.0))
    assert half_tables.gap_between(*poses, widths) == pytest.approx(0.0, abs=1e-9)
    assert half_tables.depth_of_peg(*poses, widths) == pytest.approx(half_tables.PEG_LENGTH)


def test_halves_never_start_inside_each_other() -> None:
    """Turned by 45 degrees, some placements overlap: they are not drawn."""
    task = get_task("peg_in_hole:yaw=45,size=0.2")
    rejected = 0
    for seed in range(960_000, 960_040):
        scenario = task.sample(seed)
        scene = task.at(scenario.values)
        poses = {half: scenario.pose(half) for half in (LEFT, RIGHT)}
        assert apart(scene.bodies[1], poses[LEFT], scene.bodies[2], poses[RIGHT], 0.01)
        near = {half: Pose(pose.position * (1.0, 0.6, 1.0), pose.quaternion) for half, pose in poses.items()}
        rejected += not task.admissible(near, scenario.values)
    assert rejected > 20


def test_a_half_that_is_pushed_away_is_fetched_again() -> None:
    """The left half is pushed when it stands ready and the right one is being fetched."""
    pushed = Event("push", "push", 45, 1, LEFT, (0.0, 1.2, 0.0))
    env = BimanualEnv("peg_in_hole:push=1")
    expert = ScriptedExpert(env.task_spec)
    with closing(env):
        scenario = replace(env.task_spec.sample(961_000), events=(pushed,))
        steps = list(transitions(env, expert, 961_000, scenario=scenario))
    told = [step.decision.explanation for step in steps]
    labels = [TASK.labels[each.primitive] for each in told if each is not None and each.starts]
    assert labels[:5] == ["reach_left", "grasp_left", "move_left", "retract_left", "reach_right"]
    assert labels[5:].count("move_left") == 1
    assert steps[-1].info["is_success"]
    assert TASK.horizon < len(steps) < env.task_spec.budget
