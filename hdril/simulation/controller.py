"""The controller that drives a robot's motors to commanded hand poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import Pose
from hdril.simulation.actions import HandCommand, join_action
from hdril.simulation.inverse_kinematics import IKResult, IKSettings, solve_ik
from hdril.simulation.kinematics import Chain
from hdril.simulation.robots.spec import SIDES, RobotSpec
from hdril.simulation.world import ROBOT, World


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

    def start(self, world: World, offsets: dict[str, float] | None = None) -> None:
        """Take over the robot of a new world: arms in their posture, hands open, held there.

        ``offsets`` are added to the posture, by joint, rad.
        """
        self._world = world
        self._forced_open: dict[str, int] = {}
        self._stopped: dict[int, tuple[float, int]] = {}
        self._indices = world.joint_indices(ROBOT, self.joint_names)
        self._fingers = {side: world.joint_indices(ROBOT, arm.gripper.joints) for side, arm in self._robot.arms.items()}
        self._arm_targets = {
            side: posture + [(offsets or {}).get(joint, 0.0) for joint in self._robot.arms[side].joints]
            for side, posture in self._posture.items()
        }
        self._targets = self._joint_targets(dict.fromkeys(SIDES, 1.0))
        world.reset_joints(ROBOT, self.joint_names, self._targets.tolist())
        self._drive(self._targets.tolist())
        self.results = {}

    @property
    def failures(self) -> dict[str, str]:
        """Why inverse kinematics failed at the last command, by side; empty if it did not."""
        return {side: result.reason for side, result in self.results.items() if not result.ok}

    def _joint_targets(self, openings: dict[str, float]) -> NDArray[np.float64]:
        forced = dict.fromkeys(self._forced_open, 1.0)
        fingers = [self._robot.arms[side].gripper.targets((openings | forced)[side]) for side in SIDES]
        return np.concatenate([*(self._arm_targets[side] for side in SIDES), *fingers])

    def _drive(self, targets: list[float]) -> None:
        """Set the motors' targets; those of stopped motors are replaced in the list."""
        for joint, (position, _) in self._stopped.items():
            targets[joint] = position
        self._world.drive(ROBOT, self._indices, targets, self._gains, self._forces)

    def apply(self, commands: dict[str, HandCommand]) -> None:
        """Run one control period towards ``commands``."""
        for side, command in commands.items():
            self.results[side] = self._aim(side, command.pose)
        self._ramp(self._joint_targets({side: command.opening for side, command in commands.items()}))
        self._forced_open = {side: left - 1 for side, left in self._forced_open.items() if left > 1}
        self._stopped = {joint: (at, left - 1) for joint, (at, left) in self._stopped.items() if left > 1}

    def force_open(self, side: str, periods: int) -> None:
        """Keep the fingers of a hand open for the next control periods, whatever is commanded.

        Raises:
            ValueError: there is no such hand.
        """
        if side not in SIDES:
            raise ValueError(f"no hand {side!r}; hands: {', '.join(SIDES)}")
        self._forced_open[side] = periods

    def stop_motor(self, joint: str, periods: int) -> None:
        """Hold an arm's joint where it is for the next control periods, whatever is commanded.

        Raises:
            ValueError: the arms have no such joint.
        """
        arm_joints = self.joint_names[: self._arm_count]
        if joint not in arm_joints:
            raise ValueError(f"no motor {joint!r}; motors: {', '.join(arm_joints)}")
        index = arm_joints.index(joint)
        position = self._world.joint_positions(ROBOT, self._indices)[index]
        self._stopped[index] = (float(position), periods)

    def _aim(self, side: str, pose: Pose) -> IKResult:
        """Move an arm's joint targets towards a tool pose (world), or leave them if inverse kinematics fails."""
        target, start = self._base_inverse @ pose, self._arm_targets[side]
        result = solve_ik(self._chains[side], target, start, self._posture[side], self.settings)
        if result.ok:
            # All joints are slowed alike, so that the hand lags on its path instead of leaving it.
            step, reach = result.joints - start, self._world.physics.control_period * self._max_speeds[side]
            self._arm_targets[side] = start + step / max(1.0, float(np.abs(step / reach).max()))
        return result

    def _ramp(self, goal: NDArray[np.float64]) -> None:
        """Step the world through one control period while the motor targets move to ``goal``."""
        substeps, start, done = self._world.physics.substeps, self._targets, 0
        fractions = np.arange(1, self.RAMP_STEPS + 1)[:, None] / self.RAMP_STEPS
        ramp = start + (goal - start) * fractions
        ramp[:, self._arm_count :] = goal[self._arm_count :]  # fingers close at their own speed
        for i, targets in enumerate(ramp.tolist(), start=1):
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
