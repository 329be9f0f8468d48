"""The parts of a task."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from gymnasium.utils.seeding import np_random

from hdril.geometry import POSE_AXES, Pose, about_z
from hdril.simulation.bodies import BodySpec
from hdril.simulation.robots.spec import SIDES
from hdril.simulation.sensor import SensorSpec
from hdril.simulation.world import Camera, Physics, World
from hdril.tasks.conditions import Condition, Measure, Stage, failed
from hdril.tasks.events import Event, EventSpec
from hdril.tasks.factors import COMMON, DELAY, POSITION_NOISE, ROTATION_NOISE, Factor, stream
from hdril.tasks.primitives import Primitive
from hdril.tasks.scenario import Scenario

DEFAULT_CAMERA = Camera()
DEFAULT_PHYSICS = Physics()


@dataclass(frozen=True)
class Uniform:
    """A placement: the body's origin is uniform between two corners (m), and the body is turned by ``yaw`` (rad) about z."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    yaw: float = 0.0

    @property
    def middle(self) -> Pose:
        """The middle of the area; where the body stands if the placement does not vary."""
        return Pose(0.5 * (np.array(self.low) + np.array(self.high)))

    def sample(self, rng: np.random.Generator) -> Pose:
        return Pose(rng.uniform(self.low, self.high), about_z(self.yaw))


def gym_id(task: str) -> str:
    """Gymnasium's id of a task, from its name: ``table_lift`` is ``hdril/TableLift-v0``."""
    words = re.findall(r"[A-Za-z0-9]+", task.partition(":")[0])
    return f"hdril/{''.join(word[0].upper() + word[1:] for word in words)}-v0"


@dataclass(frozen=True)
class Variation:
    """How scenes vary: the ranges of the factors that do, and how probable each event is in an episode.

    ``any_event`` is the probability that one more event happens, of a kind that is drawn from all.
    """

    spans: dict[str, float] = field(default_factory=dict)
    rates: dict[str, float] = field(default_factory=dict)
    any_event: float = 0.0

    @property
    def nominal(self) -> bool:
        """Whether nothing varies and nothing happens."""
        return not (self.spans or self.rates or self.any_event)


NOMINAL = Variation()
Values = Mapping[str, float]
"""Values of factors, by key; those that are missing are nominal."""
PLACEMENTS = 50
"""Placements that are tried before other values of the factors are drawn."""
PATIENCE = 3
"""See :attr:`Task.budget`."""


@dataclass(frozen=True)
class Task:
    """A scene, the primitives that solve it, and what counts as success, as data.

    ``bodies`` stand at ``placements[name]`` when an episode starts; those in ``observed`` are in the observation, in
    this order. Success is judged from frame ``horizon`` on, when the primitives are over. ``measures`` and ``stages`` are
    logged at every frame, to show how far a failed episode came. Success itself is the last stage and is not listed.

    Where scenes vary, the task says by ``factors`` what may vary, and ``vary`` gives the task as it is for some values of
    them: with other bodies, placements and conditions. The primitives are the same: what differs in them is a function of the
    scene. ``also_observed`` and ``attributes`` are observed beside ``observed`` then, because they differ from scene to
    scene.
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
    recovery: tuple[Primitive, ...] = ()
    """What the expert does before it starts again from an earlier primitive, if its hands are near something. Of these it
    plays the ones that have a label: a copy of a task with fewer primitives may have lost one."""
    dwell: int = 1
    """Frames for which success must hold if it comes after the horizon, so that no motion is cut off by the episode's end."""
    factors: tuple[Factor, ...] = ()
    events: tuple[EventSpec, ...] = ()
    vary: Callable[[Values], Task] | None = None
    also_observed: tuple[str, ...] = ()
    attributes: tuple[tuple[str, float], ...] = ()
    """Numbers of bodies that may differ, such as ``("table.width", 0.85)``, m; the name begins with that of the body."""
    admissible: Callable[[dict[str, Pose], Values], bool] = lambda poses, values: True
    """Whether a scene that was drawn can be; another is drawn where it cannot."""
    arrange: Callable[[dict[str, Pose]], dict[str, Pose]] = lambda poses: poses
    """What follows from the places that were drawn, such as a rack that stands on the side where the bar does not lie."""
    length: int | None = None
    """Frames of the shortest plan; the sum of the primitives unless given. Some plans skip primitives."""
    longest: int | None = None
    """Frames of the longest plan; those of the shortest unless given."""
    anchored_hands: tuple[str, ...] = SIDES
    """Hands whose pads have friction anchors, which stop what they hold from creeping through them."""
    variation: Variation = NOMINAL
    detailed: bool = False
    """Whether ``also_observed`` and ``attributes`` are observed."""

    def __post_init__(self) -> None:
        names = [body.name for body in self.bodies]
        for name in (*self.placements, *self.observed, *self.also_observed):
            if name not in names:
                raise ValueError(f"task {self.name}: no body {name!r}; bodies: {', '.join(names)}")
        if missing := set(names) - set(self.placements):
            raise ValueError(f"task {self.name}: no placement for {', '.join(sorted(missing))}")
        targets = {
            "push": [body.name for body in self.bodies if body.mass > 0.0],
            "slide": [body.name for body in self.bodies if body.mass == 0.0],
            "open_hand": list(SIDES),
        }
        for event in self.events:
            valid = targets.get(event.kind, event.targets)
            if wrong := [target for target in event.targets if target not in valid]:
                raise ValueError(
                    f"task {self.name}: {event.name} cannot happen to {wrong[0]!r}; choose from: {', '.join(valid)}"
                )

    @property
    def gym_id(self) -> str:
        """The id under which Gymnasium knows the task with the defaults of its parameters."""
        return gym_id(self.name)

    @property
    def horizon(self) -> int:
        """Frames of one demonstration in which nothing goes wrong."""
        return sum(primitive.frames for primitive in self.primitives) if self.length is None else self.length

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the primitives, each once, in the order of their first use: a label is an index into this."""
        return tuple(dict.fromkeys(primitive.name for primitive in self.primitives))

    @property
    def all_factors(self) -> tuple[Factor, ...]:
        """What may vary: the task's own factors and those of robot and observation."""
        return (*self.factors, *COMMON)

    @property
    def objects(self) -> tuple[str, ...]:
        """Bodies whose poses are observed, in this order."""
        return (*self.observed, *(self.also_observed if self.detailed else ()))

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the numbers of ``environment_state``: poses of the objects, then their attributes."""
        poses = [f"{name}.{axis}" for name in self.objects for axis in POSE_AXES]
        return (*poses, *(name for name, _ in self.attributes if self.detailed))

    @property
    def budget(self) -> int:
        """Frames after which an episode is cut unless it is said otherwise: those of the longest plan.

        Where scenes vary, three times as many, because a grasp may fail there and can be tried again.
        """
        if not self.variation.nominal:
            return PATIENCE * (self.longest or self.horizon)
        return self.horizon if self.longest is None else self.longest + self.dwell

    def sample(self, seed: int) -> Scenario:
        """The scene of a seed.

        Each factor and each event has random numbers of its own: the same seed gives the same value, whatever else varies,
        unless the scene cannot be (:attr:`admissible`); then places are drawn again, and after 50 times values too.
        """
        for attempt in range(1000):
            values = {
                key: value
                for factor in self.all_factors
                if factor.name in self.variation.spans
                for key, value in factor.draw(self.variation.spans[factor.name], seed, attempt // PLACEMENTS).items()
            }
            scene = self.at(values)
            rng = np_random(seed)[0] if attempt == 0 else stream(seed, "placements", attempt)
            poses = scene.arrange({body.name: scene.placements[body.name].sample(rng) for body in scene.bodies})
            if not values or self.admissible(poses, values):
                vectors = {body: tuple(pose.as_vector().tolist()) for body, pose in poses.items()}
                return Scenario(self.name, seed, values, vectors, self._sample_events(seed))
        raise ValueError(f"{self.name}: no scene of 1000 for seed {seed} can be; narrow the ranges")

    def _sample_events(self, seed: int) -> tuple[Event, ...]:
        rates = self.variation.rates
        chosen = [s for s in self.events if stream(seed, f"whether {s.name}").uniform() < rates.get(s.name, 0.0)]
        rng = stream(seed, "any event")
        if rng.uniform() < self.variation.any_event:
            chosen.append(self.events[int(rng.integers(len(self.events)))])
        events = [spec.sample(seed) for spec in dict.fromkeys(chosen)]
        return tuple(sorted(events, key=lambda event: event.frame))

    def at(self, values: Values) -> Task:
        """The task as it is for these values of its factors.

        Raises:
            ValueError: ``vary`` makes the scenes of another task, from which this one was copied.
        """
        own = {key: value for key, value in values.items() if key.partition(":")[0] in {f.name for f in self.factors}}
        if not own or self.vary is None:
            return self
        scene = self.vary(own)
        if scene.name.partition(":")[0] != self.name.partition(":")[0]:
            raise ValueError(
                f"task {self.name}: its vary makes scenes of {scene.name}; give it one of its own, or factors=()"
            )
        return replace(scene, name=self.name, variation=self.variation, detailed=self.detailed)

    @staticmethod
    def sensor(values: Values) -> SensorSpec:
        """How well the objects are seen."""
        return SensorSpec(
            values.get(POSITION_NOISE.name, 0.0),
            math.radians(values.get(ROTATION_NOISE.name, 0.0)),
            round(values.get(DELAY.name, 0.0)),
        )

    def episode_limit(self, frames: int | None, option: str) -> int:
        """Frames after which an episode is cut: ``frames``, or :attr:`budget` if it is None.

        Raises:
            ValueError: the episode would be cut before its success is judged; names ``option``, which set ``frames``.
        """
        if frames is not None and frames < self.horizon:
            raise ValueError(
                f"{option} must be at least {self.horizon}, got {frames}: "
                f"the success of {self.name} is judged from frame {self.horizon} on"
            )
        return self.budget if frames is None else frames

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
