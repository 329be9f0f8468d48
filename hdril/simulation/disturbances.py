"""The one door through which something happens to a running episode that no motor did."""

from __future__ import annotations

from collections.abc import Sequence

from hdril.simulation.controller import EndEffectorController
from hdril.simulation.sensor import Sensor
from hdril.simulation.world import World


class Disturbances:
    """What an event may do: a force on a body, a fixture that slides, a failing motor or hand, a blind sensor.

    Times are in control periods (frames), from the next one on. The physics test knows the simulator's functions that are
    called from here; nothing else may move a body during an episode.
    """

    def __init__(self, world: World, controller: EndEffectorController, sensor: Sensor) -> None:
        self._world, self._controller, self._sensor = world, controller, sensor

    def push(self, body: str, impulse: Sequence[float]) -> None:
        """Push a body at its centre of mass with an impulse (3,), N s in the world's frame, within half a control period."""
        self._world.push(body, impulse, self._world.physics.substeps // 2)

    def slide(self, body: str, offset: Sequence[float], frames: int) -> None:
        """Move an immovable body by ``offset`` (3,), m, at constant speed within ``frames``."""
        self._world.slide(body, offset, frames * self._world.physics.substeps)

    def open_hand(self, side: str, frames: int) -> None:
        """The fingers of a hand stay open, whatever they are told."""
        self._controller.force_open(side, frames)

    def stop_motor(self, joint: str, frames: int) -> None:
        """The motor of an arm's joint holds its position, whatever it is told."""
        self._controller.stop_motor(joint, frames)

    def blind(self, frames: int, every: int | None = None) -> None:
        """Objects are observed as they were; or anew only at each ``every``-th frame."""
        self._sensor.disturb(frames, every)
