"""Inverse kinematics: what is reported is true, and what is returned is the best that was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose, geodesic_distance
from hdril.simulation.inverse_kinematics import IKSettings, rotation_error, solve_ik
from tests.simulation.chains import ARMS

SETTINGS = IKSettings()
AXES = [*np.eye(3), *-np.eye(3), *np.random.default_rng(0).normal(size=(20, 3))]
ANGLES = [0.0, 1e-12, 1e-7, 0.3, 1.5, 3.0, *(np.pi - gap for gap in (1e-3, 2e-6, 5e-7, 1e-9, 1e-13)), np.pi]


def turned(pose: Pose, axis: np.ndarray, angle: float) -> Pose:
    """The pose turned about an axis of its parent frame."""
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    return Pose(pose.position, (turn * Rotation.from_quat(pose.quaternion)).as_quat())


@pytest.mark.parametrize("angle", ANGLES)
def test_rotation_error_is_the_rotation_that_is_missing(angle: float) -> None:
    current = Rotation.from_rotvec([0.3, -0.8, 0.5])
    for axis in AXES:
        target = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)) * current
        error = rotation_error(target.as_matrix(), current.as_matrix())
        assert np.linalg.norm(error) == pytest.approx(angle, abs=1e-9)
        np.testing.assert_allclose((Rotation.from_rotvec(error) * current).as_matrix(), target.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_finds_reachable_poses(chain, posture) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        goal = np.clip(posture + rng.normal(0, 0.15, len(posture)), chain.lower, chain.upper)
        target = chain.forward(goal)
        result = solve_ik(chain, target, posture, posture, SETTINGS)
        assert result.ok, result.reason
        reached = chain.forward(result.joints)
        assert np.linalg.norm(reached.position - target.position) < SETTINGS.position_tolerance
        assert geodesic_distance(reached.quaternion, target.quaternion) < SETTINGS.angle_tolerance
        assert (result.joints >= chain.lower).all()
        assert (result.joints <= chain.upper).all()


def targets(chain, posture) -> list[tuple[np.ndarray, Pose]]:
    """Joints to start from, and poses: near, far, out of reach, in random orientations, and turned by exactly 180 degrees."""
    rng, found = np.random.default_rng(2), []
    for i in range(8):
        start = np.clip(posture + rng.normal(0, 0.3, len(posture)), chain.lower, chain.upper)
        hand = chain.forward(start)
        axis = np.eye(3)[i % 3] if i < 3 else rng.normal(size=3)
        found += [
            (start, turned(hand, axis, np.pi)),
            (start, Pose(hand.position + rng.normal(0, 0.2, 3), rng.normal(size=4))),
            (start, turned(hand, axis, 0.2).translated(rng.normal(0, 0.03, 3))),
            (start, hand.translated((1.0, 0.0, 0.0))),
        ]
    return found


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_reported_errors_are_those_of_the_returned_joints(chain, posture) -> None:
    outcomes = set()
    for start, target in targets(chain, posture):
        for iterations in (0, 1, 3, 40):
            result = solve_ik(chain, target, start, posture, replace(SETTINGS, max_iterations=iterations))
            reached = chain.forward(result.joints)
            position = np.linalg.norm(reached.position - target.position)
            angle = geodesic_distance(reached.quaternion, target.quaternion)
            assert result.position_error == pytest.approx(position, abs=1e-9)
            assert result.angle_error == pytest.approx(float(angle), abs=1e-6)
            fits = position <= SETTINGS.accept_position and angle <= SETTINGS.accept_angle
            jump = np.abs(result.joints - start).max()
            assert result.ok == (fits and jump <= SETTINGS.max_joint_step), result
            assert ("out of reach" in result.reason) == (not fits)
            outcomes.add((fits, result.ok))
    assert outcomes == {(True, True), (True, False), (False, False)}, "each of the three outcomes should occur"


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_more_iterations_are_never_worse(chain, posture) -> None:
    improved = 0
    for start, target in targets(chain, posture):
        costs = []
        for iterations in (0, 1, 2, 4, 8, 12, 16, 30):
            result = solve_ik(chain, target, start, posture, replace(SETTINGS, max_iterations=iterations))
            costs.append(
                max(
                    result.position_error / SETTINGS.position_tolerance,
                    result.angle_error / SETTINGS.angle_tolerance,
                )
            )
        assert (np.diff(costs) <= 1e-9).all(), costs
        improved += costs[-1] < costs[0]
    assert improved > 12


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_a_hand_turned_by_180_degrees_is_not_taken_for_reached(chain, posture) -> None:
    hand = chain.forward(posture)
    for axis in AXES:
        result = solve_ik(chain, turned(hand, axis, np.pi), posture, posture, replace(SETTINGS, max_iterations=0))
        assert result.angle_error == pytest.approx(np.pi, abs=1e-6)
        assert result.reason == "out of reach by 0 mm and 180 deg"


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_a_half_turn_of_the_wrist_is_found(chain, posture) -> None:
    """From a wrist turned by nearly a half turn, solved without a limit on the jump."""
    free = replace(SETTINGS, max_joint_step=np.inf, max_iterations=200)
    start, goal = posture.copy(), posture.copy()
    start[-1], goal[-1] = -np.pi / 2, np.pi / 2
    axis = chain.transform_and_jacobian(start)[1][3:, -1]
    result = solve_ik(chain, turned(chain.forward(start), axis, np.pi), start, posture, free)
    assert result.ok, result.reason


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_what_is_out_of_reach_is_approached(chain, posture) -> None:
    far = chain.forward(posture).translated((2.0, 0.0, 0.0))
    result = solve_ik(chain, far, posture, posture, SETTINGS)
    assert result.reason.startswith("out of reach by ")
    assert f"by {1e3 * result.position_error:.0f} mm" in result.reason
    assert result.position_error < 1.6


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_a_jump_names_the_joint_that_would_make_it(chain, posture) -> None:
    goal = posture.copy()
    goal[-1] += 0.9
    result = solve_ik(chain, chain.forward(goal), posture, posture, replace(SETTINGS, max_joint_step=0.3))
    change = np.abs(result.joints - posture)
    assert result.reason == f"{chain.joints[int(change.argmax())].name} would jump by {change.max():.2f} rad"
    assert solve_ik(chain, chain.forward(goal), posture, posture, replace(SETTINGS, max_joint_step=0.9)).ok


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_the_posture_decides_among_solutions(chain, posture) -> None:
    """The arm has a joint more than a pose needs: with the posture's pull the joints come to lie nearer to it."""
    rng, nearer = np.random.default_rng(3), 0
    for _ in range(10):
        start = np.clip(posture + rng.normal(0, 0.2, len(posture)), chain.lower, chain.upper)
        target = chain.forward(start).translated(rng.normal(0, 0.01, 3))
        pulled = solve_ik(chain, target, start, posture, SETTINGS)
        free = solve_ik(chain, target, start, posture, replace(SETTINGS, posture_gain=0.0))
        assert pulled.ok
        nearer += np.linalg.norm(pulled.joints - posture) < np.linalg.norm(free.joints - posture)
    assert nearer >= 9


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_one_iteration_moves_no_joint_by_more_than_a_step(chain, posture) -> None:
    far = chain.forward(posture).translated((0.6, 0.3, 0.3))
    for iterations in (1, 2):
        limited = replace(SETTINGS, max_iterations=iterations)
        change = np.abs(solve_ik(chain, far, posture, posture, limited).joints - posture).max()
        assert change == pytest.approx(iterations * SETTINGS.max_step) or change < iterations * SETTINGS.max_step
    assert change > SETTINGS.max_step


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_the_start_is_not_changed(chain, posture) -> None:
    start = posture.copy()
    for target in (chain.forward(posture), chain.forward(posture).translated((0.02, 0.0, 0.0))):
        result = solve_ik(chain, target, start, posture, SETTINGS)
        result.joints[:] = 0.0
        np.testing.assert_array_equal(start, posture)


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_converges_quadratically_near_the_goal(chain, posture) -> None:
    """Damping falls with the error: three iterations take 3 cm to below a tenth of a millimetre."""
    exact = replace(SETTINGS, posture_iterations=0, max_iterations=3)
    for offset in ((0.02, 0.0, 0.01), (0.0, -0.03, 0.0), (-0.01, 0.01, 0.02)):
        result = solve_ik(chain, chain.forward(posture).translated(offset), posture, posture, exact)
        assert result.position_error < SETTINGS.position_tolerance


@pytest.mark.parametrize(("chain", "posture"), ARMS)
def test_iterates_follow_the_equation(chain, posture) -> None:
    """dq = J# e + (I - J# J) g (posture - q), J# = J^T (J J^T + d^2 I)^-1, d^2 = d0^2 + (c |e|)^2; the best one is returned."""
    rng, eye = np.random.default_rng(5), np.eye(len(posture))
    given = replace(SETTINGS, damping=0.02, damping_per_error=0.3, posture_gain=0.2, max_step=0.05)
    given = replace(given, position_tolerance=1e-9, angle_tolerance=1e-8)  # no iterate here comes as close
    for _ in range(5):
        start = q = posture + rng.normal(0, 0.2, len(posture))
        target, iterates = chain.forward(start + rng.normal(0, 0.1, len(posture))), []
        for iteration in range(5):
            transform, jacobian = chain.transform_and_jacobian(q)
            rotation = Rotation.from_matrix(target.rotation_matrix() @ transform[:3, :3].T).as_rotvec()
            error = np.concatenate([target.position - transform[:3, 3], rotation])
            position, angle = np.linalg.norm(error[:3]), np.linalg.norm(rotation)
            iterates.append((max(position / given.position_tolerance, angle / given.angle_tolerance), q))
            result = solve_ik(chain, target, start, posture, replace(given, max_iterations=iteration))
            np.testing.assert_allclose(result.joints, min(iterates, key=lambda entry: entry[0])[1], atol=1e-9)
            squared = given.damping**2 + (given.damping_per_error * np.linalg.norm(error)) ** 2
            inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + squared * np.eye(6))
            step = inverse @ error
            if iteration < given.posture_iterations:
                step = step + (eye - inverse @ jacobian) @ (given.posture_gain * (posture - q))
            q = np.clip(q + np.clip(step, -given.max_step, given.max_step), chain.lower, chain.upper)
