"""What is particular to table lift: grips that turn with the table, and a goal that the robot can reach."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hdril.geometry import Pose
from hdril.simulation.actions import HandCommand
from hdril.simulation.robots import SIDES
from hdril.tasks import get_task
from hdril.tasks.primitives import Scene
from hdril.tasks.table_lift import (
    GRIPS,
    HANDLE_Y,
    LEG_X,
    LEG_Y,
    OFF_BENCH,
    OVER_PLATFORM,
    PLATFORM_DEPTH,
    PLATFORM_WIDTH,
    PLATFORM_X,
    TASK,
    goal_x,
    goal_y,
)
from hdril.tasks.task import Task
from tests.tasks.waypoints import waypoints

SIGNS = dict(zip(SIDES, (1.0, -1.0), strict=True))


def scene(
    yaw: float = 0.0,
    at: tuple[float, float, float] = (0.55, 0.0, 0.0),
    platform: tuple[float, float] = (PLATFORM_X, 0.0),
) -> Scene:
    """The nominal bodies, with the table turned by ``yaw`` deg."""
    half = 0.5 * math.radians(yaw)
    objects = {
        "table": Pose(at, (0.0, 0.0, math.sin(half), math.cos(half))),
        "platform": Pose((*platform, 0.0)),
    }
    blank = Scene({}, objects, {}, dict(TASK.attributes))
    hands = {side: HandCommand(GRIPS[side].tool(blank), 0.0) for side in SIDES}
    return replace(blank, hands=hands, measured={side: replace(hand, opening=0.3) for side, hand in hands.items()})


def pitch(pose: Pose) -> float:
    """How far a hand points down, deg."""
    return math.degrees(math.asin(-pose.rotation_matrix()[2, 2]))


# ---------------------------------------------------------------------- grips


@pytest.mark.parametrize("y", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize("side", SIDES)
def test_a_table_that_stands_square_is_gripped_at_the_middle_of_the_handles_at_45_degrees(side: str, y: float) -> None:
    tool = GRIPS[side].tool(scene(at=(0.6, y, 0.0)))
    assert pitch(tool) == pytest.approx(45.0)
    assert tool.position == pytest.approx((0.6, y + SIGNS[side] * HANDLE_Y, 0.355))


@pytest.mark.parametrize("side", SIDES)
def test_a_handle_that_is_turned_towards_the_robot_is_gripped_more_steeply_and_square(side: str) -> None:
    turned = scene(yaw=25.0 * SIGNS[side])
    tool, table = GRIPS[side].tool(turned), turned.objects["table"]
    assert pitch(tool) > 70.0
    # The jaws' axis is that of the handle's thickness.
    assert abs(tool.rotation_matrix()[:, 1] @ table.rotation_matrix()[:, 1]) == pytest.approx(1.0)


@pytest.mark.parametrize("side", SIDES)
def test_a_handle_that_is_turned_away_and_far_aside_is_gripped_from_within(side: str) -> None:
    sign = SIGNS[side]

    def grip(yaw: float) -> tuple[float, float, float]:
        """Its pitch and how far outwards it is turned, deg, and how far it is from the handle's middle, towards the robot, mm."""
        turned = scene(yaw=-yaw * sign, at=(0.5, 0.28 * sign, 0.0))
        tool = turned.objects["table"].inverse() @ GRIPS[side].tool(turned)
        heading = tool.rotation_matrix()[:2, 2]
        return pitch(tool), sign * math.degrees(math.atan2(heading[1], heading[0])), -1000.0 * tool.position[0]

    assert grip(15.0) == pytest.approx((58.0, 20.0, 20.0), abs=0.5)
    assert grip(30.0) == pytest.approx((45.0, 40.0, 30.0), abs=0.5)
    near = scene(yaw=-25.0 * sign, at=(0.5, -0.1 * sign, 0.0))
    assert pitch(GRIPS[side].tool(near)) == pytest.approx(45.0)


@pytest.mark.parametrize("side", SIDES)
def test_grips_are_mirror_images(side: str) -> None:
    other = SIDES[1 - SIDES.index(side)]
    for yaw in (-28.0, -12.0, 6.0, 20.0):
        for y in (-0.25, 0.1, 0.3):
            tool = GRIPS[side].tool(scene(yaw, at=(0.55, y, 0.0)))
            mirrored = GRIPS[other].tool(scene(-yaw, at=(0.55, -y, 0.0)))
            assert tool.position == pytest.approx(mirrored.position * (1, -1, 1))
            assert tool.rotation_matrix()[:, 2] == pytest.approx(mirrored.rotation_matrix()[:, 2] * (1, -1, 1))


@pytest.mark.parametrize("side", SIDES)
def test_grips_change_smoothly_with_the_scene(side: str) -> None:
    """A policy must be able to learn them, and a plan that follows the table must not jump."""
    for y in (-0.3, 0.0, 0.3):
        tools = [GRIPS[side].tool(scene(yaw, at=(0.5, y, 0.0))) for yaw in np.arange(-40.0, 40.0, 0.5).tolist()]
        for before, after in pairwise(tools):
            assert np.linalg.norm(after.position - before.position) < 0.01
            assert np.linalg.norm(after.rotation_matrix() - before.rotation_matrix()) < 0.1


def test_hands_turn_in_their_grips_while_the_table_stands() -> None:
    """At the end of ``move`` both hands are pitched to carry the table, wherever they gripped it, and where its handles are."""
    start, move = scene(yaw=25.0, at=(0.5, 0.2, 0.0)), TASK.primitives[1]
    assert max(pitch(hand.pose) for hand in start.hands.values()) > 70.0
    last = waypoints(move, start)[-1].reshape(2, 8)
    for side, vector in zip(SIDES, last, strict=True):
        hand = Pose.from_vector(vector[:7])
        assert pitch(hand) == pytest.approx(45.0, abs=0.01)
        assert hand.position[1] == pytest.approx(SIGNS[side] * HANDLE_Y, abs=0.02)


# ---------------------------------------------------------------------- the goal


def test_the_nominal_goal_is_the_middle_of_the_platform() -> None:
    assert (goal_x(scene()), goal_y(scene())) == (PLATFORM_X, 0.0)


def test_the_goal_is_within_reach_and_all_legs_stand_on_the_platform() -> None:
    task = get_task("table_lift:level=varied")
    nearer = 0
    for seed in range(300):
        scenario = task.sample(seed)
        at = task.at(scenario.values)
        attributes = dict(at.attributes)
        varied = Scene({}, {name: scenario.pose(name) for name in scenario.poses}, {}, attributes)
        x, y, _ = varied.objects["platform"].position
        off_x, off_y = goal_x(varied) - x, goal_y(varied) - y
        legs_x, legs_y = LEG_X * attributes["table.depth"] / 0.35, LEG_Y * attributes["table.length"] / 0.85
        assert abs(off_x) + legs_x <= PLATFORM_DEPTH / 2
        assert abs(off_y) + legs_y <= PLATFORM_WIDTH / 2
        assert off_x <= 0.0
        assert abs(y + off_y) <= abs(y)
        nearer += off_x < -0.01
    assert nearer > 50


@pytest.mark.parametrize(("offset", "over"), [((0.0, 0.0), True), ((0.05, 0.0), True), ((0.09, 0.0), False),
                                              ((0.0, 0.09), True), ((0.0, 0.14), False)])  # fmt: skip
def test_a_table_is_over_the_platform_if_its_legs_are(offset: tuple[float, float], over: bool) -> None:
    for sign in (1.0, -1.0):
        at = (PLATFORM_X + sign * offset[0], sign * offset[1], 0.18)
        assert OVER_PLATFORM.holds(scene(at=at)) is over


# ---------------------------------------------------------------------- what is kept


def _after(primitive: int, before: Scene) -> dict[str, HandCommand]:
    rows = waypoints(TASK.primitives[primitive], before)
    halfway = rows[len(rows) // 2].reshape(2, 8)
    return {side: HandCommand(Pose.from_vector(row[:7]), row[7]) for side, row in zip(SIDES, halfway, strict=True)}


def _with_open_hand(side: str, before: Scene) -> Scene:
    return replace(before, hands=before.hands | {side: replace(before.hands[side], opening=1.0)})


@pytest.mark.parametrize("lost", SIDES)
def test_a_hand_that_alone_holds_a_raised_table_keeps_it(lost: str) -> None:
    raised = _with_open_hand(lost, scene(at=(0.8, 0.0, 0.1)))
    (kept,) = set(SIDES) - {lost}
    hand = _after(0, raised)[kept]
    assert hand.opening == 0.0
    assert hand.pose.position == pytest.approx(raised.hands[kept].pose.position)
    assert _after(0, raised)[lost].opening == 1.0


@pytest.mark.parametrize("lost", SIDES)
@pytest.mark.parametrize("task", [TASK, get_task("clear_and_lift")], ids=lambda task: task.name)
def test_from_the_first_frame_to_the_last_a_kept_hand_stays_as_it_was(task: Task, lost: str) -> None:
    """Where the expert tries a grasp again, it opens the other hand, goes back with it, and grasps."""
    raised = _with_open_hand(lost, scene(at=(0.8, 0.0, 0.1)))
    (kept,) = set(SIDES) - {lost}
    columns = slice(0, 8) if kept == "left" else slice(8, 16)
    (retreat,), grasp = task.recovery, next(p for p in task.primitives if p.name == "grasp")
    for primitive in (retreat, grasp):
        rows = waypoints(primitive, raised)
        hand = raised.hands[kept]
        assert rows[:, columns] == pytest.approx(np.tile([*hand.pose.as_vector(), hand.opening], (len(rows), 1)))
        assert np.ptp(np.delete(rows, np.arange(16)[columns], axis=1)[:, :3], axis=0).max() > 0.05


@pytest.mark.parametrize("lost", SIDES)
def test_a_hand_that_alone_holds_a_table_on_the_bench_lets_go_of_it(lost: str) -> None:
    standing = _with_open_hand(lost, scene())
    assert all(hand.opening == 1.0 for hand in _after(0, standing).values())


def test_a_table_that_is_off_the_bench_is_lifted_and_not_slid() -> None:
    move = TASK.primitives[1]
    assert not OFF_BENCH.holds(scene())
    assert move.possible(scene())
    assert not move.superfluous(scene())
    assert move.superfluous(scene(at=(0.7, 0.0, 0.08)))
