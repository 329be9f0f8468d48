"""One-handed primitives that pass a bar from one hand to the other, and what they need.

The hand on the rack's side is the receiver, the other is the giver. The bar is the body ``bar``, square in section, its x axis
along it; the rack is the body ``rack``. Each primitive is made for one hand, named by its side, and passed over where the
other hand has that part.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose
from hdril.simulation.actions import HandCommand
from hdril.simulation.robots.spec import OTHER, SIDES, SIGN
from hdril.tasks.primitives import Hands, Need, Primitive, Scene, Segment

Vector = NDArray[np.float64]
Goal = Callable[[Scene], Hands]

X, Y, Z = np.eye(3)

THICKNESS = 0.03
"""Of the bar, m; the jaws open to 4.8 cm or more."""
MEET_X, MEET_Z = 0.52, 0.36
GRIP = 0.25
"""Where a hand holds the bar, from its middle, as a part of its length: further out, a heavy bar turns in the fingers."""
GRIP_DEPTH = 0.005
"""How far the tool's origin is below the bar's axis, m: the finger tips then end 6 mm over what the bar lies on."""
PREFERRED = math.radians(-30.0)
"""The heading in the middle of those that a hand is turned to: -90 deg where the bar is passed, 0 at the rack."""
OUTWARD = math.radians(45.0)
"""The only heading, of those tried from 0 to 90 deg, with which the wrist stands a bar up wherever the rack may be."""


@dataclass(frozen=True)
class Rest:
    """How the bar lies or stands in the rack."""

    upright: bool
    tolerance: tuple[float, float]
    """How far the bar's middle may be off, along the rack's x and y, m."""
    above: float
    """How high the bar is brought over the rack before it is lowered, m."""
    frames: tuple[int, int, int]
    """Of ``carry``, ``insert`` and ``retract``."""

    def middle(self, attributes: dict[str, float]) -> float:
        """Height of the middle of a bar that rests in the rack over the rack's foot, m."""
        return attributes["rack.height"] + 0.5 * (attributes["bar.length"] if self.upright else THICKNESS)

    def aligned(self, bar: Pose, least: float = 0.99) -> bool:
        """Whether the bar is within arccos(``least``) of the direction in which it rests."""
        return abs(float(along(bar)[2 if self.upright else 0])) > least

    def reached(self, bar: Pose, rack: Pose, height: float) -> bool:
        """Whether the bar rests in the rack, where its middle is ``height`` m over the rack's foot."""
        x, y, z = np.abs((rack.inverse() @ bar).position - (0.0, 0.0, height))
        return bool(x < self.tolerance[0] and y < self.tolerance[1] and z < 0.01 and self.aligned(bar))

    def over(self, scene: Scene) -> bool:
        """Whether the bar is over the rack, so that it can be squared and lowered."""
        offset = np.abs(scene.objects["bar"].position - scene.objects["rack"].position)
        return bool((offset[:2] < 0.04).all() and self.aligned(scene.objects["bar"], 0.9 if self.upright else 0.98))


def in_rack(scene: Scene, rest: Rest) -> bool:
    """Whether the bar rests in the rack."""
    return rest.reached(scene.objects["bar"], scene.objects["rack"], rest.middle(scene.attributes))


# ---------------------------------------------------------------------- what is seen


def side_of(pose: Pose) -> str:
    """The hand on whose side something is."""
    return "left" if pose.position[1] > 0.0 else "right"


def receiver(scene: Scene) -> str:
    """The hand on the rack's side."""
    return side_of(scene.objects["rack"])


def along(bar: Pose) -> Vector:
    """Unit vector (3,) along the bar."""
    return bar.rotation_matrix()[:, 0]


def holds_bar(scene: Scene, side: str) -> bool:
    """Whether a hand was told to close, is not empty, and has the bar between its fingers."""
    hand = scene.measured[side]
    x, y, z = (scene.objects["bar"].inverse() @ hand.pose).position
    inside = abs(x) < scene.attributes["bar.length"] / 2 + 0.01 and math.hypot(y, z) < 0.03
    return bool(scene.hands[side].opening < 0.5 and hand.opening > 0.2 and inside)


def near_bar(scene: Scene, side: str) -> bool:
    """Whether a hand is so near to the bar that it may touch it."""
    x, y, z = (scene.objects["bar"].inverse() @ scene.measured[side].pose).position
    return bool(abs(x) < scene.attributes["bar.length"] / 2 + 0.05 and math.hypot(y, z) < 0.08)


def at_meeting(scene: Scene) -> bool:
    """Whether the bar is held up in the middle, across."""
    bar = scene.objects["bar"]
    return bool(np.linalg.norm(bar.position - (MEET_X, 0.0, MEET_Z)) < 0.08 and abs(along(bar)[1]) > 0.9)


def waits(scene: Scene, side: str, rest: Rest) -> bool:
    """Whether the bar lies on a hand's side and is to be picked up."""
    held = any(holds_bar(scene, each) for each in SIDES)
    return side_of(scene.objects["bar"]) == side and not held and not in_rack(scene, rest)


def gives(scene: Scene, side: str) -> bool:
    """Whether a hand is the giver, and the receiver does not hold the bar yet."""
    return receiver(scene) != side and not holds_bar(scene, OTHER[side])


def _held(side: str) -> Need:
    return Need(f"{side} hand holds the bar", lambda scene: holds_bar(scene, side))


# ---------------------------------------------------------------------- grips and places


def _heading(side: str, free: Vector) -> float:
    """Heading of a hand whose bar extends along ``free``, rad: 0 if that is forward; inwards is negative on both sides."""
    return SIGN[side] * math.atan2(free[1], free[0])


def lying_end(scene: Scene, side: str) -> float:
    """The end, 1 or -1 along the bar, at which a hand picks it up: the one that turns the wrist less."""
    axis = along(scene.objects["bar"])

    def turn(end: float) -> float:
        return abs(math.remainder(_heading(side, -end * axis) - PREFERRED, 2.0 * math.pi))

    return min((1.0, -1.0), key=turn)


def held_end(scene: Scene, side: str) -> float:
    """The end, 1 or -1 along the bar, at which a hand is."""
    return math.copysign(1.0, (scene.objects["bar"].inverse() @ scene.measured[side].pose).position[0])


def free_end(scene: Scene, side: str) -> float:
    """The end at which the other hand is not."""
    return -held_end(scene, OTHER[side])


def _pointing_down(x: Vector) -> Vector:
    """Orientation (4,) of a tool with this x axis (unit, 3) whose z axis is as near to straight down as it can be."""
    z = -Z + x[2] * x
    z /= np.linalg.norm(z)
    return Rotation.from_matrix(np.stack((x, np.cross(z, x), z), axis=1)).as_quat()


def grip(scene: Scene, end: float) -> Pose:
    """A tool that points down at an end of the bar, jaws across it; its x axis points away from the other end."""
    x = end * along(scene.objects["bar"])
    position = scene.objects["bar"].position + GRIP * scene.attributes["bar.length"] * x
    return Pose(position, _pointing_down(x)) @ Pose((0.0, 0.0, GRIP_DEPTH))


def turned(bar: Pose, tool: Pose, end: float, free: Vector, approach: Vector) -> Pose:
    """The bar, turned so that it extends along ``free`` from the tool at its ``end``, and so that the tool points along
    ``approach``.

    A tool that is askew is not squared: the side of the bar that it is nearest to pointing through is.
    """
    axes = bar.rotation_matrix()
    points = axes.T @ tool.rotation_matrix()[:, 2]
    side = 1 + int(np.abs(points[1:]).argmax())
    columns = np.zeros((3, 3))
    columns[:, 0], columns[:, side] = -end * free, math.copysign(1.0, points[side]) * approach
    rest = 3 - side
    columns[:, rest] = np.cross(columns[:, (rest + 1) % 3], columns[:, (rest + 2) % 3])
    return Pose(bar.position, Rotation.from_matrix(columns).as_quat())


# ---------------------------------------------------------------------- goals


def _at_end(side: str, end: Callable[[Scene, str], float], opening: float, above: float = 0.0) -> Goal:
    """One hand at an end of the bar, ``above`` metres over its grip; the other stays."""

    def goal(scene: Scene) -> Hands:
        tool = grip(scene, end(scene, side)).translated(above * Z)
        return scene.hands | {side: HandCommand(tool, opening)}

    return goal


def _carried(side: str, free: Vector, approach: Vector, place: Callable[[Scene], Vector]) -> Goal:
    """One hand with the bar in it, whose middle goes to ``place(scene)``; the other hand stays."""

    def goal(scene: Scene) -> Hands:
        # From where the hand is, not from where it was told to be: after a long way the arm lags, and the bar with it.
        bar, hand = scene.objects["bar"], scene.measured[side].pose
        there = turned(bar, hand, held_end(scene, side), free, approach)
        motion = Pose(place(scene), there.quaternion) @ bar.inverse()
        return scene.hands | {side: HandCommand(motion @ hand, scene.hands[side].opening)}

    return goal


def outward(side: str) -> Vector:
    """Where a hand points that stands the bar in the rack: forward and :data:`OUTWARD` to its own side."""
    return np.array((math.cos(OUTWARD), SIGN[side] * math.sin(OUTWARD), 0.0))


def _to_rack(side: str, rest: Rest, above: float) -> Goal:
    """One hand with the bar in it, ``above`` metres over where it comes to rest."""

    def place(scene: Scene) -> Vector:
        return scene.objects["rack"].position + (rest.middle(scene.attributes) + above) * Z

    free, approach = (-Z, outward(side)) if rest.upright else (X, -Z)
    return _carried(side, free, approach, place)


def _before_tipping(side: str) -> Goal:
    """One hand with the bar in it, which extends to where the hand will not point: from here the wrist can stand it up."""
    return _carried(side, -outward(side), -Z, lambda scene: np.array((0.39, SIGN[side] * 0.29, 0.45)))


def _ready(side: str) -> HandCommand:
    """An open hand beside the place where the bar is passed, higher than it."""
    return HandCommand(Pose((MEET_X, SIGN[side] * 0.28, MEET_Z + 0.14), _pointing_down(SIGN[side] * Y)), 1.0)


def _backed_off(hand: HandCommand, distance: float) -> HandCommand:
    """The hand, opened, ``distance`` m back along its approach."""
    return HandCommand(hand.pose @ Pose((0.0, 0.0, -distance)), 1.0)


# ---------------------------------------------------------------------- primitives


def pick(side: str, rest: Rest) -> Primitive:
    """Take the bar where it lies, at the end that turns the wrist less."""
    return Primitive(
        f"pick_{side}",
        (
            Segment(8, _at_end(side, lying_end, 1.0, above=0.10), follows=("bar",)),
            Segment(4, _at_end(side, lying_end, 1.0), jitter=0.25, follows=("bar",)),
            Segment(2, _at_end(side, lying_end, 0.0), jitter=0.0),
        ),
        unless=Need("bar on the other side, held or in the rack", lambda scene: not waits(scene, side, rest)),
    )


def bring(side: str) -> Primitive:
    """Lift the bar and hold it across the middle, while the receiver gets ready."""
    meet = _carried(side, -SIGN[side] * Y, -Z, lambda scene: np.array((MEET_X, 0.0, MEET_Z)))

    def lifted(scene: Scene) -> Hands:
        hand = scene.hands[side]
        return scene.hands | {side: HandCommand(hand.pose.translated(0.08 * Z), hand.opening)}

    def met(scene: Scene) -> Hands:
        return meet(scene) | {OTHER[side]: _ready(OTHER[side])}

    return Primitive(
        f"bring_{side}",
        (Segment(4, lifted, jitter=0.25), Segment(10, met)),
        needs=(_held(side),),
        unless=Need("not the giver, or the receiver holds the bar", lambda scene: not gives(scene, side)),
    )


def take(side: str) -> Primitive:
    """Take the end of the bar that the giver does not hold."""
    return Primitive(
        f"take_{side}",
        (
            Segment(4, _at_end(side, free_end, 1.0, above=0.10), follows=("bar",)),
            Segment(4, _at_end(side, free_end, 1.0), jitter=0.25, follows=("bar",)),
            Segment(2, _at_end(side, free_end, 0.0), jitter=0.0),
        ),
        needs=(_held(OTHER[side]), Need("bar in the middle", at_meeting)),
        unless=Need("not the receiver, or holds the bar", lambda scene: not gives(scene, OTHER[side])),
    )


def release(side: str) -> Primitive:
    """The giver opens its hand, backs out, and gets out of the way."""

    def goal(distance: float) -> Goal:
        return lambda scene: scene.hands | {side: _backed_off(scene.hands[side], distance)}

    return Primitive(
        f"release_{side}",
        (
            Segment(2, goal(0.0), jitter=0.0),
            Segment(3, goal(0.12), jitter=0.25),
            Segment(3, lambda scene: scene.hands | {side: _ready(side)}, jitter=0.25),
        ),
        needs=(_held(OTHER[side]),),
        unless=Need("not the giver, or away from the bar", lambda s: receiver(s) == side or not near_bar(s, side)),
    )


def carry(side: str, rest: Rest) -> Primitive:
    """Bring the bar over the rack, turned as it will rest."""
    tip = 8 if rest.upright else 0
    return Primitive(
        f"carry_{side}",
        (
            *((Segment(tip, _before_tipping(side), follows=("rack",)),) if tip else ()),
            Segment(rest.frames[0] - tip, _to_rack(side, rest, rest.above), follows=("rack",)),
        ),
        needs=(_held(side), Need("giver away from the bar", lambda scene: not near_bar(scene, OTHER[side]))),
        unless=Need("not the receiver, or the bar in the rack", lambda s: receiver(s) != side or in_rack(s, rest)),
    )


def insert(side: str, rest: Rest) -> Primitive:
    """Square the bar, which has turned in the fingers while it was carried, and lower it into the rack."""
    square = 4
    return Primitive(
        f"insert_{side}",
        (
            Segment(square, _to_rack(side, rest, rest.above), jitter=0.25, follows=("rack",)),
            Segment(rest.frames[1] - square, _to_rack(side, rest, 0.0), jitter=0.25, follows=("rack",)),
        ),
        needs=(_held(side), Need("bar over the rack", rest.over)),
        unless=Need("not the receiver, or the bar in the rack", lambda s: receiver(s) != side or in_rack(s, rest)),
    )


def retract(name: str, frames: int = 8, told: bool = True) -> Primitive:
    """Open both hands and back out, from where they were told to be, or from where they are.

    A hand that a stopped motor kept away must not sweep over the counter to where it was told to be.
    """

    def goal(distance: float) -> Goal:
        def back(scene: Scene) -> Hands:
            hands = scene.hands if told else scene.measured
            return {side: _backed_off(hand, distance) for side, hand in hands.items()}

        return back

    return Primitive(name, (Segment(2, goal(0.0), jitter=0.0), Segment(frames - 2, goal(0.12), jitter=0.25)))
