"""Sixteen numbers, and the commands that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from hdril.geometry import Pose
from hdril.simulation.actions import (
    ACTION_NAMES,
    HAND_WIDTH,
    HandCommand,
    check_action,
    hand_poses,
    hand_slice,
    join_action,
    openings,
    split_action,
)

NAMES = [
    f"{side}_{name}"
    for side in ("left", "right")
    for name in ("ee.x", "ee.y", "ee.z", "ee.qx", "ee.qy", "ee.qz", "ee.qw", "gripper.pos")
]
LEFT = HandCommand(Pose((0.1, 0.2, 0.3), (0.0, 1.0, 0.0, 0.0)), 0.25)
RIGHT = HandCommand(Pose((-0.4, 0.5, -0.6), (0.5, -0.5, 0.5, 0.5)), 0.75)
ACTION = np.array([0.1, 0.2, 0.3, 0.0, 1.0, 0.0, 0.0, 0.25, -0.4, 0.5, -0.6, 0.5, -0.5, 0.5, 0.5, 0.75])


def test_names() -> None:
    assert list(ACTION_NAMES) == NAMES
    assert HAND_WIDTH == 8


def test_slices_find_the_numbers_of_a_hand() -> None:
    assert [name.split("_")[0] for name in ACTION_NAMES[hand_slice("left")]] == ["left"] * 8
    assert [name.split("_")[0] for name in ACTION_NAMES[hand_slice("right")]] == ["right"] * 8
    with pytest.raises(ValueError, match=r"^no hand 'middle'; hands: left, right$"):
        hand_slice("middle")


def test_an_action_stands_for_two_commands() -> None:
    commands = split_action(ACTION)
    assert list(commands) == ["left", "right"]
    for side, command in (("left", LEFT), ("right", RIGHT)):
        np.testing.assert_array_equal(commands[side].pose.as_vector(), command.pose.as_vector())
        assert commands[side].opening == command.opening


def test_commands_are_joined_left_before_right() -> None:
    np.testing.assert_array_equal(join_action({"right": RIGHT, "left": LEFT}), ACTION)


def test_rows_are_taken_apart_by_hand() -> None:
    rows = np.stack([ACTION, ACTION + 1.0, ACTION - 1.0]).astype(np.float32)
    poses = hand_poses(rows)
    assert poses.shape == (3, 2, 7)
    assert poses.dtype == openings(rows).dtype == np.float64
    np.testing.assert_allclose(poses[0, 0], LEFT.pose.as_vector(), atol=1e-7)
    np.testing.assert_allclose(poses[1, 1], RIGHT.pose.as_vector() + 1.0, atol=1e-6)
    np.testing.assert_allclose(openings(rows), [[0.25, 0.75], [1.25, 1.75], [-0.75, -0.25]], atol=1e-6)


def test_openings_are_clipped_and_quaternions_scaled() -> None:
    action = ACTION.copy()
    action[hand_slice("left")] = [0.1, 0.2, 0.3, 0.0, 2.0, 0.0, 0.0, -0.5]
    action[ACTION_NAMES.index("right_gripper.pos")] = 1.5
    commands = split_action(action)
    assert (commands["left"].opening, commands["right"].opening) == (0.0, 1.0)
    assert commands["left"].pose.quaternion.tolist() == [0.0, 1.0, 0.0, 0.0]


def test_a_checked_action_is_the_same_in_double_precision() -> None:
    checked = check_action(ACTION.astype(np.float32))
    assert checked.dtype == np.float64
    np.testing.assert_array_equal(checked, ACTION.astype(np.float32))


@pytest.mark.parametrize("shape", [(14,), (17,), (2, 8), ()])
def test_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"^an action has 16 numbers, left_ee\.x to right_gripper\.pos; got shape \("):
        check_action(np.ones(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["left_ee.x", "left_gripper.pos", "right_ee.qw", "right_gripper.pos"])
def test_numbers_that_are_not_finite_are_named(name: str, value: float) -> None:
    action = ACTION.copy()
    action[ACTION_NAMES.index(name)] = value
    with pytest.raises(ValueError, match=rf"^the action is not finite: {name} = {value}$"):
        check_action(action)


def test_every_number_that_is_not_finite_is_named() -> None:
    action = ACTION.copy()
    action[[1, 8]] = np.nan
    with pytest.raises(ValueError, match=r"left_ee\.y = nan, right_ee\.x = nan$"):
        split_action(action)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_quaternion_without_length_is_refused(side: str) -> None:
    action = ACTION.copy()
    quaternion = [i for i, name in enumerate(ACTION_NAMES) if name.startswith(f"{side}_ee.q")]
    action[quaternion] = [0.0, 0.0, 0.0, 0.9e-6]
    with pytest.raises(ValueError, match=rf"^the action's {side}_ee quaternion has length 0$"):
        check_action(action)
    action[quaternion] = [0.0, 0.0, 0.0, 1.1e-6]
    assert split_action(action)[side].pose.quaternion.tolist() == [0.0, 0.0, 0.0, 1.0]
    for axis in range(4):
        action[quaternion] = np.eye(4)[axis]
        assert check_action(action)[quaternion].tolist() == np.eye(4)[axis].tolist()
