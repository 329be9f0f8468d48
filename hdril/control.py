"""From commanded hand poses to motor targets: inverse kinematics, and the controller that runs it on a robot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdril.conditions import ROBOT
from hdril.geometry import POSE_AXES, Pose
from hdril.kinematics import Chain
from hdril.robots.spec import SIDES, RobotSpec
from hdril.world import World

ACTION_NAMES: tuple[str, ...] = tuple(
    name for side in SIDES for name in (*(f"{side}_ee.{axis}" for axis in POSE_AXES), f"{side}_gripper.pos")
)
"""Names of the 16 numbers of an action, and of ``observation.state``."""


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


@dataclass(frozen=True)
class HandCommand:
    """What one hand is told: a tool pose in the world, and an opening from 0 (closed) to 1."""

    pose: Pose
    opening: float


def check_action(action: NDArray[np.floating]) -> NDArray[np.float64]:
    """The action as float64 (16,).

    Raises:
        ValueError: wrong shape, a number that is not finite, or a quaternion of length 0; names the entries.
    """
    array = np.asarray(action, dtype=np.float64)
    if array.shape != (len(ACTION_NAMES),):
        raise ValueError(
            f"an action has {len(ACTION_NAMES)} numbers, {ACTION_NAMES[0]} to {ACTION_NAMES[-1]}; got shape {array.shape}"
        )
    if not np.isfinite(array).all():
        bad = [f"{name} = {value}" for name, value in zip(ACTION_NAMES, array, strict=True) if not np.isfinite(value)]
        raise ValueError(f"the action is not finite: {', '.join(bad)}")
    for i, side in enumerate(SIDES):
        if np.linalg.norm(array[8 * i + 3 : 8 * i + 7]) < 1e-6:
            raise ValueError(f"the action's {side}_ee quaternion has length 0")
    return array


def split_action(action: NDArray[np.floating]) -> dict[str, HandCommand]:
    """Commands by side, from 16 numbers in the order of :data:`ACTION_NAMES`. Raises as :func:`check_action`."""
    array = check_action(action)
    return {
        side: HandCommand(Pose.from_vector(array[8 * i : 8 * i + 7]), float(np.clip(array[8 * i + 7], 0.0, 1.0)))
        for i, side in enumerate(SIDES)
    }


def join_action(commands: dict[str, HandCommand]) -> NDArray[np.float64]:
    """The inverse of :func:`split_action`."""
    return np.concatenate([np.append(commands[side].pose.as_vector(), commands[side].opening) for side in SIDES])


class EndEffectorController:
    """Drives a two-armed robot to commanded hand poses, one control period at a time.

    Motor targets move on a straight line in joint space from the last command to the new one, no faster than the
    joints' speed limits, so that the arms arrive at the end of the period instead of rushing there. When inverse
    kinematics has no answer for an arm, that arm keeps its last target and :attr:`failures` says so.
    """

    RAMP_STEPS = 8
    """Motor targets per control period: every third of 24 timesteps."""

    def __init__(self, robot: RobotSpec, settings: IKSettings | None = None) -> None:
        self._robot = robot
        self.settings = settings or IKSettings()
        self._chains = {side: Chain(robot.source(), robot.base_link, arm.tool) for side, arm in robot.arms.items()}
        self._base_inverse = robot.base.inverse()
        self._posture = {side: np.array(arm.posture) for side, arm in robot.arms.items()}
        arm_joints = [joint for arm in robot.arms.values() for joint in arm.joints]
        finger_joints = [joint for arm in robot.arms.values() for joint in arm.gripper.joints]
        self.joint_names = [*arm_joints, *finger_joints]
        """The joints that it drives: arms, then fingers, left before right."""
        self._arm_count = len(arm_joints)
        actuation = robot.actuation
        self._gains = [actuation.arm_gain] * len(arm_joints) + [actuation.finger_gain] * len(finger_joints)
        self._forces = [actuation.efforts[joint] for joint in self.joint_names]
        self._max_speeds = {
            side: np.array([actuation.velocities[joint] for joint in arm.joints]) for side, arm in robot.arms.items()
        }
        self.results: dict[str, IKResult] = {}

    def start(self, world: World) -> None:
        """Take over the robot of a new world: arms in their posture, hands open, held there."""
        self._world = world
        self._indices = world.joint_indices(ROBOT, self.joint_names)
        self._fingers = {side: world.joint_indices(ROBOT, arm.gripper.joints) for side, arm in self._robot.arms.items()}
        self._arm_targets = {side: posture.copy() for side, posture in self._posture.items()}
        self._targets = self._joint_targets(dict.fromkeys(SIDES, 1.0))
        world.reset_joints(ROBOT, self.joint_names, self._targets.tolist())
        self._drive(self._targets)
        self.results = {}

    @property
    def failures(self) -> dict[str, str]:
        """Why inverse kinematics failed at the last command, by side; empty if it did not."""
        return {side: result.reason for side, result in self.results.items() if not result.ok}

    def _joint_targets(self, openings: dict[str, float]) -> NDArray[np.float64]:
        fingers = [self._robot.arms[side].gripper.targets(openings[side]) for side in SIDES]
        return np.concatenate([*(self._arm_targets[side] for side in SIDES), *fingers])

    def _drive(self, targets: NDArray[np.float64]) -> None:
        self._world.drive(ROBOT, self._indices, targets.tolist(), self._gains, self._forces)

    def apply(self, commands: dict[str, HandCommand]) -> None:
        """Run one control period towards ``commands``."""
        period = self._world.physics.control_period
        for side, command in commands.items():
            target = self._base_inverse @ command.pose
            result = solve_ik(self._chains[side], target, self._arm_targets[side], self._posture[side], self.settings)
            self.results[side] = result
            if result.ok:
                # All joints are slowed alike, so that the hand lags on its path instead of leaving it.
                step = result.joints - self._arm_targets[side]
                slowdown = max(1.0, float(np.abs(step / (period * self._max_speeds[side])).max()))
                self._arm_targets[side] = self._arm_targets[side] + step / slowdown
        goal = self._joint_targets({side: command.opening for side, command in commands.items()})
        substeps = self._world.physics.substeps
        start, done = self._targets, 0
        for i in range(1, self.RAMP_STEPS + 1):
            targets = start + (goal - start) * (i / self.RAMP_STEPS)
            targets[self._arm_count :] = goal[self._arm_count :]  # fingers close at their own speed
            self._drive(targets)
            upto = i * substeps // self.RAMP_STEPS
            self._world.step(upto - done)
            done = upto
        self._targets = goal

    def hold(self, substeps: int) -> None:
        """Let the world run with the motor targets as they are."""
        self._world.step(substeps)

    def hand_pose(self, side: str) -> Pose:
        """Measured pose of a hand's tool frame in the world."""
        pose = self._world.link_pose(ROBOT, self._robot.arms[side].tool)
        return pose.aligned_to(self._robot.hand_reference)

    def opening(self, side: str) -> float:
        """Measured opening of a hand, 0 to 1."""
        positions = self._world.joint_positions(ROBOT, self._fingers[side])
        return self._robot.arms[side].gripper.opening(positions)

    def observe(self) -> NDArray[np.float64]:
        """(16,): measured hand poses and openings, in the order of :data:`ACTION_NAMES`."""
        return join_action({side: HandCommand(self.hand_pose(side), self.opening(side)) for side in SIDES})
