"""Inverse kinematics of one arm: damped least squares with a posture in the null space."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import Pose
from hdril.simulation.kinematics import Chain

_SMALL_SINE = 1e-6
"""Below it, sin(angle) is too small to divide by."""


@dataclass(frozen=True)
class IKSettings:
    """Damped least squares. Lengths in m, angles in rad."""

    damping: float = 1e-3
    damping_per_error: float = 0.1
    """Levenberg's damping grows with the remaining error, so that the last steps converge quadratically."""
    posture_gain: float = 0.1
    posture_iterations: int = 2
    """The posture pulls in the first iterations alone: with damping, the null space leaks into the pose."""
    max_step: float = 0.3
    """Largest change of one joint in one iteration."""
    max_iterations: int = 40
    position_tolerance: float = 1e-4
    angle_tolerance: float = 1e-3
    accept_position: float = 2e-3
    accept_angle: float = math.radians(1.0)
    max_joint_step: float = 0.8
    """A larger change of one joint in one control period is a jump to another branch of solutions."""


@dataclass(frozen=True)
class IKResult:
    """Joint positions (n,), rad, and the errors of their pose (m, rad); ``reason`` is empty if they are acceptable."""

    joints: NDArray[np.float64]
    position_error: float
    angle_error: float
    reason: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason


def rotation_error(target: NDArray[np.float64], current: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vector (3,), rad, that takes ``current`` to ``target``, both (3, 3), in their common parent frame.

    For R = target current^T of angle a about the unit axis u, (R - R^T) / 2 = sin(a) [u]x and tr R = 1 + 2 cos(a). Near
    a = pi the sine vanishes, and the axis is read from the symmetric part, (R + R^T) / 2 = cos(a) I + (1 - cos(a)) u u^T.
    At pi exactly, u and -u are the same rotation; either may be returned.
    """
    relative = target @ current.T
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = relative.tolist()
    x, y, z = 0.5 * (r21 - r12), 0.5 * (r02 - r20), 0.5 * (r10 - r01)
    sine, cosine = math.sqrt(x * x + y * y + z * z), 0.5 * (r00 + r11 + r22 - 1.0)
    angle = math.atan2(sine, cosine)
    if sine < _SMALL_SINE and cosine < 0.0:
        return angle * _axis_near_pi(relative, np.array((x, y, z)))
    scale = angle / sine if sine > 1e-9 else 1.0  # a / sin(a) is 1 at small angles
    return np.array((scale * x, scale * y, scale * z))


def _axis_near_pi(rotation: NDArray[np.float64], sine_axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit axis (3,) of a rotation by nearly pi; ``sine_axis`` = sin(a) u gives its sign."""
    outer = 0.5 * (rotation + rotation.T) + np.eye(3)  # 2 u u^T: cos(a) is -1 within 1e-12 here
    column = outer[:, int(np.diag(outer).argmax())]
    axis = column / np.linalg.norm(column)
    return -axis if axis @ sine_axis < 0.0 else axis


def solve_ik(
    chain: Chain, target: Pose, start: NDArray[np.float64], posture: NDArray[np.float64], settings: IKSettings
) -> IKResult:
    """Damped least squares with a posture in the null space, from ``start`` (n,), rad.

    dq = J^T (J J^T + d^2 I)^-1 e + (I - J^+ J) g (posture - q), with d^2 = d0^2 + (c |e|)^2, clipped to the joint
    limits, until the pose error e is within tolerance. ``target`` is in the chain's base frame.

    Returns:
        The best iterate, and the errors of exactly these joints. An iterate's cost is the larger of its position error and
        its angle error, each in units of its tolerance, so the cost is below 1 where both are within tolerance. ``reason``
        says what is wrong if the pose is out of reach, or if a joint would have to jump; the caller decides what to do then.
    """
    goal_rotation = target.rotation_matrix()
    q, best, best_cost = start, start, math.inf
    error, best_errors = np.empty(6), (math.inf, math.inf)
    position_scale, angle_scale = settings.position_tolerance**2, settings.angle_tolerance**2
    for iteration in range(settings.max_iterations + 1):
        transform, jacobian = chain.transform_and_jacobian(q)
        error[:3] = target.position - transform[:3, 3]
        error[3:] = rotation_error(goal_rotation, transform[:3, :3])
        position_squared, angle_squared = float(error[:3] @ error[:3]), float(error[3:] @ error[3:])
        cost = max(position_squared / position_scale, angle_squared / angle_scale)
        if cost < best_cost:
            best, best_cost, best_errors = q, cost, (position_squared, angle_squared)
        if cost < 1.0 or iteration == settings.max_iterations:
            break
        pull = settings.posture_gain * (posture - q) if iteration < settings.posture_iterations else None
        step = _damped_step(jacobian, error, position_squared + angle_squared, pull, settings)
        # Plain minimum and maximum: np.clip takes three times as long on seven numbers.
        step = np.minimum(np.maximum(step, -settings.max_step), settings.max_step)
        q = np.minimum(np.maximum(q + step, chain.lower), chain.upper)
    position_error, angle_error = (math.sqrt(squared) for squared in best_errors)
    reason = _objection(chain, best - start, position_error, angle_error, settings)
    return IKResult(best.copy(), position_error, angle_error, reason)


def _damped_step(
    jacobian: NDArray[np.float64],
    error: NDArray[np.float64],
    error_squared: float,
    pull: NDArray[np.float64] | None,
    settings: IKSettings,
) -> NDArray[np.float64]:
    """dq (n,), rad, of one iteration; ``pull`` (n,), rad, is what the posture asks for, if it does."""
    gram = jacobian @ jacobian.T
    gram.flat[::7] += settings.damping**2 + settings.damping_per_error**2 * error_squared
    if pull is None:
        return jacobian.T @ np.linalg.solve(gram, error)
    return jacobian.T @ np.linalg.solve(gram, error - jacobian @ pull) + pull


def _objection(
    chain: Chain, change: NDArray[np.float64], position_error: float, angle_error: float, settings: IKSettings
) -> str:
    """Why a solution that changes the joints by ``change`` (n,), rad, is not acceptable; empty if it is."""
    if position_error > settings.accept_position or angle_error > settings.accept_angle:
        return f"out of reach by {1e3 * position_error:.0f} mm and {math.degrees(angle_error):.0f} deg"
    worst = int(np.abs(change).argmax())
    if (jump := abs(float(change[worst]))) > settings.max_joint_step:
        return f"{chain.joints[worst].name} would jump by {jump:.2f} rad"
    return ""
