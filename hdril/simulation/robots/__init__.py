"""Robots by name: Baxter, and those of other packages.

Another package adds a robot by an entry point of the group ``hdril.robots`` that names a :class:`RobotSpec`. The name of the
entry point must be the name of the robot::

    [project.entry-points."hdril.robots"]
    two_pandas = "my_package.two_pandas:ROBOT"
"""

from hdril.plugins import Registry
from hdril.simulation.robots.baxter import BAXTER
from hdril.simulation.robots.spec import SIDES, Actuation, ArmSpec, GripperSpec, RobotSpec


def _read(source: object) -> RobotSpec:
    if not isinstance(source, RobotSpec):
        raise TypeError(f"{source!r} is not a hdril.simulation.robots.RobotSpec")
    return source


ROBOTS: Registry[RobotSpec] = Registry("robot", "hdril.robots", {BAXTER.name: BAXTER}, _read)
"""Robots by name."""

__all__ = ["ROBOTS", "SIDES", "Actuation", "ArmSpec", "GripperSpec", "RobotSpec"]
