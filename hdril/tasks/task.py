"""The parts of a task."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec
from hdril.simulation.world import Camera, Physics, World
from hdril.tasks.conditions import Condition, Measure, Stage, failed
from hdril.tasks.primitives import Primitive

DEFAULT_CAMERA = Camera()
DEFAULT_PHYSICS = Physics()


@dataclass(frozen=True)
class Uniform:
    """A placement: the body's origin is uniform between two corners (m), its axes those of the world."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def sample(self, rng: np.random.Generator) -> Pose:
        return Pose(rng.uniform(self.low, self.high))


def gym_id(task: str) -> str:
    """Gymnasium's id of a task, from its name: ``table_lift`` is ``hdril/TableLift-v0``."""
    words = re.findall(r"[A-Za-z0-9]+", task.partition(":")[0])
    return f"hdril/{''.join(word[0].upper() + word[1:] for word in words)}-v0"


@dataclass(frozen=True)
class Task:
    """A scene, the primitives that solve it, and what counts as success, as data.

    ``bodies`` stand at ``placements[name]`` when an episode starts; those in ``observed`` are in the observation, in
    this order. Success is judged from frame ``horizon`` on, when the primitives are over. ``measures`` and ``stages`` are
    logged at every frame, to show how far a failed episode came. Success itself is the last stage and is not listed.
    """

    name: str
    """Lower case, words joined by underscores, and parameters after a colon: ``peg_in_hole:clearance=0.003``."""
    description: str
    """The instruction, in words: LeRobot's ``task``."""
    bodies: tuple[BodySpec, ...]
    placements: dict[str, Uniform]
    observed: tuple[str, ...]
    primitives: tuple[Primitive, ...]
    success: tuple[Condition, ...]
    measures: tuple[Measure, ...] = ()
    stages: tuple[Stage, ...] = ()
    camera: Camera = DEFAULT_CAMERA
    physics: Physics = DEFAULT_PHYSICS

    def __post_init__(self) -> None:
        names = [body.name for body in self.bodies]
        for name in (*self.placements, *self.observed):
            if name not in names:
                raise ValueError(f"task {self.name}: no body {name!r}; bodies: {', '.join(names)}")
        if missing := set(names) - set(self.placements):
            raise ValueError(f"task {self.name}: no placement for {', '.join(sorted(missing))}")

    @property
    def gym_id(self) -> str:
        """The id under which Gymnasium knows the task with the defaults of its parameters."""
        return gym_id(self.name)

    @property
    def horizon(self) -> int:
        """Frames of one demonstration."""
        return sum(primitive.frames for primitive in self.primitives)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the primitives, each once, in the order of their first use: a label is an index into this."""
        return tuple(dict.fromkeys(primitive.name for primitive in self.primitives))

    def episode_limit(self, frames: int | None, option: str) -> int:
        """Frames after which an episode is cut: ``frames``, or the horizon if it is None.

        Raises:
            ValueError: the episode would be cut before its success is judged; names ``option``, which set ``frames``.
        """
        if frames is not None and frames < self.horizon:
            raise ValueError(
                f"{option} must be at least {self.horizon}, got {frames}: "
                f"the success of {self.name} is judged from frame {self.horizon} on"
            )
        return self.horizon if frames is None else frames

    def read_measures(self, world: World) -> dict[str, float]:
        """The measures by name."""
        return {measure.name: measure.read(world) for measure in self.measures}

    def stages_reached(self, world: World, before: int) -> int:
        """How many stages have been reached, given how many had been at the frame before."""
        while before < len(self.stages) and not failed(self.stages[before].conditions, world):
            before += 1
        return before


def fixed(position: Sequence[float]) -> Uniform:
    """A placement that does not vary."""
    x, y, z = position
    return Uniform((x, y, z), (x, y, z))
