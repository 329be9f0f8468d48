"""Robots by name."""

from hdril.simulation.robots.baxter import BAXTER
from hdril.simulation.robots.spec import SIDES, Actuation, ArmSpec, GripperSpec, RobotSpec

ROBOTS: dict[str, RobotSpec] = {robot.name: robot for robot in (BAXTER,)}

__all__ = ["ROBOTS", "SIDES", "Actuation", "ArmSpec", "GripperSpec", "RobotSpec"]
