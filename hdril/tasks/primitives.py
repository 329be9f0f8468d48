"""Movement primitives: labelled pieces of a demonstration, each a short list of waypoints for both hands.

A primitive is planned from what is observed at its first frame, so that each one starts from where the objects really are.
The functions under "constructors" make the primitives; a task puts them in order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import Pose, interpolate
from hdril.simulation.actions import HandCommand, join_action
from hdril.simulation.robots.spec import SIDES

Hands = dict[str, HandCommand]


@dataclass(frozen=True)
class Scene:
    """What a primitive is planned from: what the hands were last told, and where the observed objects are (world)."""

    hands: Hands
    objects: dict[str, Pose]


@dataclass(frozen=True)
class Segment:
    """``frames`` waypoints from the hands of the segment before to ``goal(scene)``.

    ``jitter`` scales the expert's noise. ``rigid`` gives both hands the same noise, because two stiff hands that hold one
    body work against each other if they differ.

    Raises:
        ValueError: there is not one frame.
    """

    frames: int
    goal: Callable[[Scene], Hands]
    jitter: float = 1.0
    rigid: bool = False

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ValueError(f"a segment of a primitive must have at least 1 frame, got {self.frames}")


@dataclass(frozen=True)
class Primitive:
    """A label and the segments that make its waypoints."""

    name: str
    segments: tuple[Segment, ...]

    @property
    def frames(self) -> int:
        return sum(segment.frames for segment in self.segments)


@dataclass(frozen=True)
class Noise:
    """Variety in demonstrations: the standard deviation, m, of a waypoint's offset. The offset is zero where a segment ends.

    Raises:
        ValueError: the deviation is out of range.
    """

    waypoint: float = 0.004

    def __post_init__(self) -> None:
        if not 0.0 <= self.waypoint <= 0.02:
            raise ValueError(f"noise.waypoint must be from 0 to 0.02 m, got {self.waypoint}")


def _ease(fraction: float) -> float:
    """3 s^2 - 2 s^3: starts and ends at rest, and peaks at 1.5 times the mean speed (minimum jerk: 1.9 times)."""
    return fraction**2 * (3.0 - 2.0 * fraction)


def _offsets(segment: Segment, noise: Noise, rng: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    """Smooth random offsets (frames, 3), m, by side: n j sin(pi s) (a + b cos(pi s)), with a and b standard normal.

    s runs from 1 / frames to 1, n is the noise and j the jitter. The last offset is zero.
    """
    fractions = np.arange(1, segment.frames + 1) / segment.frames
    envelope = np.sin(np.pi * fractions)[:, None]
    offsets = {side: rng.normal(size=(2, 3)) for side in SIDES}
    if segment.rigid:
        offsets["right"] = offsets["left"]
    wave = np.stack([np.ones_like(fractions), np.cos(np.pi * fractions)], axis=1)
    return {side: noise.waypoint * segment.jitter * envelope * (wave @ draw) for side, draw in offsets.items()}


def plan(primitive: Primitive, scene: Scene, noise: Noise, rng: np.random.Generator) -> NDArray[np.float64]:
    """Waypoints (frames, 16) of a primitive from ``scene``, in the order of :data:`hdril.simulation.actions.ACTION_NAMES`."""
    waypoints, start = [], scene.hands
    for segment in primitive.segments:
        goal, offsets = segment.goal(scene), _offsets(segment, noise, rng)
        for i in range(segment.frames):
            fraction = _ease((i + 1) / segment.frames)
            hands = {
                side: HandCommand(
                    interpolate(start[side].pose, goal[side].pose, fraction).translated(offsets[side][i]),
                    goal[side].opening,
                )
                for side in SIDES
            }
            waypoints.append(join_action(hands))
        start = goal
    return np.stack(waypoints)


# ---------------------------------------------------------------------- goals


@dataclass(frozen=True)
class Grip:
    """Where a hand takes hold: a tool pose in the frame of a body."""

    body: str
    pose: Pose


Grips = dict[str, Grip]
"""A grip for each side."""


def at_grips(grips: Grips, opening: float, back_off: float = 0.0, above: float = 0.0) -> Callable[[Scene], Hands]:
    """Each hand at its grip, backed off along its approach (tool z) and raised (world z) by metres."""

    def goal(scene: Scene) -> Hands:
        retreat = Pose((0.0, 0.0, -back_off))
        return {
            side: HandCommand((scene.objects[grip.body] @ grip.pose @ retreat).translated((0.0, 0.0, above)), opening)
            for side, grip in grips.items()
        }

    return goal


Targets = Callable[[Scene], dict[str, Pose]]
"""Where bodies are to go, by name, given where everything is."""


def carry_to(held: dict[str, str], targets: Targets) -> Callable[[Scene], Hands]:
    """Each hand moved with the body it holds (``held[side]``): hand' = target body^-1 hand, from what it was last told."""

    def goal(scene: Scene) -> Hands:
        goals = targets(scene)
        motions = {body: goals[body] @ scene.objects[body].inverse() for body in goals}
        return {side: HandCommand(motions[held[side]] @ hand.pose, hand.opening) for side, hand in scene.hands.items()}

    return goal


def hands_at(opening: float, back_off: float = 0.0, rise: float = 0.0) -> Callable[[Scene], Hands]:
    """Each hand where it was told to be, opened, backed off along its approach and raised, m."""

    def goal(scene: Scene) -> Hands:
        return {
            side: HandCommand((hand.pose @ Pose((0.0, 0.0, -back_off))).translated((0.0, 0.0, rise)), opening)
            for side, hand in scene.hands.items()
        }

    return goal


# ---------------------------------------------------------------------- constructors


def grasp(grips: Grips, frames: int = 10, clearance: float = 0.08) -> Primitive:
    """Approach with open hands, reach in along the approach axis, close."""
    close, reach = 2, 3
    return Primitive(
        "grasp",
        (
            Segment(frames - close - reach, at_grips(grips, 1.0, back_off=clearance)),
            Segment(reach, at_grips(grips, 1.0), jitter=0.25),
            Segment(close, at_grips(grips, 0.0), jitter=0.0),
        ),
    )


def reach(name: str, grips: Grips, frames: int = 10, above: float = 0.12) -> Primitive:
    """Bring open hands to ``above`` metres over their grips."""
    return Primitive(name, (Segment(frames, at_grips(grips, 1.0, above=above)),))


def lower(name: str, grips: Grips, frames: int = 10) -> Primitive:
    """Come down on the grips with open hands, and close."""
    close = 3
    return Primitive(
        name,
        (
            Segment(frames - close, at_grips(grips, 1.0), jitter=0.25),
            Segment(close, at_grips(grips, 0.0), jitter=0.0),
        ),
    )


def carry(name: str, body: str, target: Callable[[Pose], Pose], frames: int = 12, jitter: float = 1.0) -> Primitive:
    """Take a body that both hands hold to ``target(body pose)``."""
    goal = carry_to(dict.fromkeys(SIDES, body), lambda scene: {body: target(scene.objects[body])})
    return Primitive(name, (Segment(frames, goal, jitter=jitter, rigid=True),))


def carry_each(
    name: str, held: dict[str, str], targets: Targets, frames: int = 12, jitter: float = 1.0, rigid: bool = False
) -> Primitive:
    """Take the body in each hand to its own target. ``rigid`` once the bodies are joined."""
    return Primitive(name, (Segment(frames, carry_to(held, targets), jitter=jitter, rigid=rigid),))


def move(body: str, x: float, y: float, frames: int = 12) -> Primitive:
    """Slide a held body over the bench to (x, y), m, squaring it to the world's axes."""
    return carry("move", body, lambda pose: Pose((x, y, pose.position[2])), frames, jitter=0.5)


def lift(body: str, height: float, frames: int = 12) -> Primitive:
    """Raise a held body to ``height``, m, level."""
    return carry("lift", body, lambda pose: Pose((pose.position[0], pose.position[1], height)), frames)


def extend(body: str, x: float, y: float, frames: int = 12) -> Primitive:
    """Bring a lifted body forward to (x, y), m, level."""
    return carry("extend", body, lambda pose: Pose((x, y, pose.position[2])), frames)


def place(body: str, height: float, frames: int = 12) -> Primitive:
    """Set a held body down on a surface at ``height``, m."""
    return carry("place", body, lambda pose: Pose((pose.position[0], pose.position[1], height)), frames, jitter=0.5)


def lift_joined(name: str = "lift", rise: float = 0.12, squeeze: float = 0.006, frames: int = 10) -> Primitive:
    """Raise what both hands hold between them, each hand pressing by ``squeeze``, m, towards the other.

    Bodies that only a peg joins sag in the middle and come apart without the pressure.
    """

    def goal(scene: Scene) -> Hands:
        left, right = scene.hands["left"].pose, scene.hands["right"].pose
        inwards = (right.position - left.position) / np.linalg.norm(right.position - left.position)
        return {
            side: HandCommand(hand.pose.translated(sign * squeeze * inwards + (0.0, 0.0, rise)), hand.opening)
            for (side, hand), sign in zip(scene.hands.items(), (1.0, -1.0), strict=True)
        }

    return Primitive(name, (Segment(frames, goal, rigid=True),))


def retract(name: str = "retract", frames: int = 12, distance: float = 0.10, rise: float = 0.10) -> Primitive:
    """Open, back out along the approach, rise; straight up if ``distance`` is 0."""
    release = 2
    back = (frames - release) // 2 if distance else 0
    return Primitive(
        name,
        (
            Segment(release, hands_at(1.0), jitter=0.0),
            *((Segment(back, hands_at(1.0, back_off=distance), jitter=0.25),) if back else ()),
            Segment(frames - release - back, hands_at(1.0, back_off=distance, rise=rise), jitter=1.0 if back else 0.25),
        ),
    )
