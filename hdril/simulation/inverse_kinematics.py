"""Inverse kinematics of one arm: damped least squares with a posture in the null space."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import Pose
from hdril.simulation.kinematics import Chain


@dataclass(frozen=True)
class IKSettings:
    """Damped least squares. Lengths in m, angles in rad."""

    damping: float = 1e-3
    damping_per_error: float = 0.1
    """Levenberg's damping grows with the remaining error, so that the last steps converge quadratically."""
    posture_gain: float = 0.1
    posture_iterations: int = 2
    """The posture pulls in the first iterations alone: damped, its null space leaks into the pose."""
    max_iterations: int = 40
    position_tolerance: float = 1e-4
    angle_tolerance: float = 1e-3
    accept_position: float = 2e-3
    accept_angle: float = np.deg2rad(1.0)
    max_joint_step: float = 0.8
    """A larger change of one joint in one control period is a jump to another branch of solutions."""


@dataclass(frozen=True)
class IKResult:
    """Joint positions (n,), rad, with the errors that remain (m, rad); ``reason`` is empty if they are acceptable."""

    joints: NDArray[np.float64]
    position_error: float
    angle_error: float
    reason: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason


def _rotation_error(target: NDArray[np.float64], current: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vector (3,), rad, that takes ``current`` to ``target`` (3, 3), base frame."""
    relative = target @ current.T
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = relative.tolist()
    x, y, z = 0.5 * (r21 - r12), 0.5 * (r02 - r20), 0.5 * (r10 - r01)
    sine = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, 0.5 * (r00 + r11 + r22 - 1.0))
    scale = angle / sine if sine > 1e-9 else 1.0  # at small angles a / sin(a) is 1; at pi any step will do
    return np.array((scale * x, scale * y, scale * z))


def solve_ik(
    chain: Chain, target: Pose, start: NDArray[np.float64], posture: NDArray[np.float64], settings: IKSettings
) -> IKResult:
    """Damped least squares with a posture in the null space, from ``start``.

    dq = J^T (J J^T + d^2 I)^-1 e + (I - J^+ J) g (posture - q), with d^2 = d0^2 + (c |e|)^2, clipped to the joint
    limits, until the pose error e is within tolerance. ``target`` is in the chain's base frame.

    Returns:
        The best joint positions found. ``reason`` says what is wrong if the pose is out of reach, or if a joint would
        have to jump; the caller decides what to do then.
    """
    goal_rotation = target.rotation_matrix()
    q, eye, n = start.copy(), np.eye(6), len(start)
    error = np.empty(6)
    for iteration in range(settings.max_iterations):
        transform, jacobian = chain.transform_and_jacobian(q)
        error[:3] = target.position - transform[:3, 3]
        error[3:] = _rotation_error(goal_rotation, transform[:3, :3])
        position_squared, angle_squared = error[:3] @ error[:3], error[3:] @ error[3:]
        if position_squared < settings.position_tolerance**2 and angle_squared < settings.angle_tolerance**2:
            break
        damping = settings.damping**2 + settings.damping_per_error**2 * (position_squared + angle_squared)
        gram = jacobian @ jacobian.T + damping * eye
        if iteration < settings.posture_iterations:
            pull = settings.posture_gain * (posture - q)
            step = jacobian.T @ np.linalg.solve(gram, error - jacobian @ pull) + pull
        else:
            step = jacobian.T @ np.linalg.solve(gram, error)
        # Plain minimum and maximum: np.clip takes three times as long on seven numbers.
        q = np.minimum(np.maximum(q + np.minimum(np.maximum(step, -0.3), 0.3), chain.lower), chain.upper)
    position_error, angle_error = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    reason = ""
    if position_error > settings.accept_position or angle_error > settings.accept_angle:
        reason = f"out of reach by {1e3 * position_error:.0f} mm and {np.rad2deg(angle_error):.0f} deg"
    elif (jump := float(np.abs(q - start).max())) > settings.max_joint_step:
        name = chain.joints[int(np.abs(q - start).argmax())].name
        reason = f"{name} would jump by {jump:.2f} rad (n = {n})"
    return IKResult(q, position_error, angle_error, reason)
