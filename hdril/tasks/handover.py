"""Handover: a bar lies on one side of a counter and belongs into a rack on the other; one hand passes it to the other.

Which side the bar lies on is drawn. The hand on that side is the giver: the rack is out of its reach. The other, the receiver,
cannot reach the bar where it lies. A planner has to see which hand picks; a wrong one closes on nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hdril.geometry import Pose, about_z
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.robots.spec import SIDES
from hdril.simulation.world import ROBOT, World
from hdril.tasks.bench import ARM_JOINTS, BENCH, BENCH_PLACEMENT
from hdril.tasks.conditions import Condition, Stage, at_rest, not_touching, touching
from hdril.tasks.events import EventSpec
from hdril.tasks.factors import Factor
from hdril.tasks.passing import (
    OUTWARD,
    THICKNESS,
    Rest,
    bring,
    carry,
    in_rack,
    insert,
    pick,
    release,
    retract,
    side_of,
    take,
)
from hdril.tasks.primitives import Need, Primitive
from hdril.tasks.task import Task, Uniform, Values, fixed

LENGTH, MASS = 0.34, 0.25
COUNTER = 0.18
"""Height of the counter. On the bench itself, 1.1 m below the shoulders, no hand can point down."""
RACK_HEIGHT, POST, WALL = {False: 0.06, True: 0.10}, 0.03, 0.08
BAR_X, BAR_Y = (0.46, 0.56), (0.56, 0.64)
RACK_X, RACK_Y = (0.48, 0.54), (0.54, 0.60)
YAW = math.radians(15.0)
REST = {
    False: Rest(upright=False, tolerance=(0.03, 0.012), above=0.12, frames=(12, 11, 8)),
    True: Rest(upright=True, tolerance=(0.015, 0.015), above=0.15, frames=(22, 13, 12)),
}
"""Flat, and upright."""

WOOD, STEEL, GREY = (0.80, 0.62, 0.42, 1.0), (0.35, 0.42, 0.50, 1.0), (0.75, 0.76, 0.78, 1.0)
FACTORS = (
    Factor("yaw", "offset", 30.0, 45.0, "deg", "the bar's heading, beside the nominal 15 deg"),
    Factor("size", "scale", 0.15, 0.25, "", "length of the bar"),
    Factor("mass", "ratio", 2.0, 3.0, "", "the bar's mass"),
    Factor("friction", "scale", 0.4, 0.6, "", "friction of the bar on counter, rack and pads"),
    Factor("rack", "offset", 0.10, 0.12, "m", "where the rack stands", ("x", "y")),
    Factor("rack_height", "offset", 0.04, 0.05, "m", "how high the rack is"),
)
EVENTS = (
    EventSpec("push", "push", (1, 11), ("bar",), strength=(0.05, 0.15)),
    EventSpec("push_held", "push", (18, 56), ("bar",), strength=(0.05, 0.15)),
    EventSpec("open_hand", "open_hand", (12, 60), SIDES, frames=(3, 6)),
    EventSpec("stop_motor", "stop_motor", (2, 60), ARM_JOINTS, frames=(5, 10)),
    EventSpec("rack_slide", "slide", (12, 52), ("rack",), frames=(8, 12), strength=(0.03, 0.06)),
    EventSpec("freeze", "freeze", (0, 56), frames=(5, 15)),
    EventSpec("repeat", "repeat", (0, 56), frames=(15, 30)),
)

# ---------------------------------------------------------------------- scene

_COUNTER = BodySpec(
    "counter", (Box((0.60, 1.70, COUNTER), (0.0, 0.0, COUNTER / 2), GREY),), friction=0.5, anchored=False
)


@dataclass(frozen=True)
class EitherSide(Uniform):
    """A placement on the left or on the right, as likely, at a distance ``near`` or more from the middle (y = 0).

    The body's heading is ``yaw`` and up to ``spread`` more or less, rad; it is mirrored with the side.
    """

    near: float = 0.0
    spread: float = 0.0

    def sample(self, rng: np.random.Generator) -> Pose:
        sign = rng.choice((-1.0, 1.0))
        x, y = rng.uniform(self.low[0], self.high[0]), rng.uniform(self.near, self.high[1])
        return Pose((x, sign * y, self.low[2]), about_z(sign * (self.yaw + rng.uniform(-self.spread, self.spread))))


def _either_side(
    x: tuple[float, float], y: tuple[float, float], z: float, yaw: float = 0.0, spread: float = 0.0
) -> EitherSide:
    return EitherSide((x[0], -y[1], z), (x[1], y[1], z), yaw, near=y[0], spread=spread)


def _opposite(poses: dict[str, Pose]) -> dict[str, Pose]:
    """The rack on the side where the bar does not lie."""
    bar, rack = poses["bar"], poses["rack"]
    if bar.position[1] * rack.position[1] < 0.0:
        return poses
    mirrored = Pose(rack.position * (1.0, -1.0, 1.0), rack.quaternion * (1.0, 1.0, -1.0, 1.0))
    return poses | {"rack": mirrored}


def _bar(values: Values) -> BodySpec:
    return BodySpec(
        "bar",
        (Box((LENGTH * values.get("size", 1.0), THICKNESS, THICKNESS), (0.0, 0.0, 0.0), WOOD),),
        mass=MASS * values.get("mass", 1.0),
        friction=0.8 * values.get("friction", 1.0),
        anchored=False,
    )


def _cradle(height: float) -> BodySpec:
    """A block with two pairs of posts on it, and a plate on each that leads the bar in; it lies between them along x."""
    inner, post = THICKNESS / 2 + 0.010, 0.02
    boxes = [Box((0.16, 0.11, height), (0.0, 0.0, height / 2), STEEL)]
    for x in (-0.035, 0.035):
        for quarter in (1, 3):
            upright = Box((post, post, POST), (inner + post / 2, 0.0, height + POST / 2), STEEL)
            for box in (upright, _lead_in(inner, height + POST, post)):
                turned = _turned(box, quarter)
                boxes.append(replace(turned, centre=(turned.centre[0] + x, *turned.centre[1:])))
    return BodySpec("rack", tuple(boxes), anchored=False)


def _socket(height: float) -> BodySpec:
    """A block with four walls on it, and a plate on each that leads the bar in; the bar stands between them."""
    inner, wall = THICKNESS + 2 * 0.006, 0.02
    boxes = [Box((0.12, 0.12, height), (0.0, 0.0, height / 2), STEEL)]
    for quarter in range(4):
        x, z = (inner + wall) / 2, height + WALL / 2
        boxes.append(_turned(Box((wall, inner + 2 * wall, WALL), (x, 0.0, z), STEEL), quarter))
        boxes.append(_turned(_lead_in(inner / 2, height + WALL, inner), quarter))
    return BodySpec("rack", tuple(boxes), anchored=False)


def _lead_in(x: float, z: float, width: float) -> Box:
    """A plate whose inner surface rises from (x, z) outwards, 30 degrees off vertical."""
    tilt, length, thickness = math.radians(30.0), 0.03, 0.006
    quaternion = (0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2))
    middle = Pose((x, 0.0, z), quaternion) @ Pose((thickness / 2, 0.0, length / 2))
    a, b, c = middle.position.tolist()
    return Box((thickness, width, length), (a, b, c), STEEL, quaternion)


def _turned(box: Box, quarter: int) -> Box:
    """The box, turned by quarters of a turn about the rack's z axis."""
    pose = Pose((0.0, 0.0, 0.0), about_z(quarter * math.pi / 2)) @ Pose(box.centre, box.quaternion)
    (x, y, z), (a, b, c, d) = pose.position.tolist(), pose.quaternion.tolist()
    return replace(box, centre=(x, y, z), quaternion=(a, b, c, d))


# ---------------------------------------------------------------------- success


def _held_up(world: World) -> bool:
    return bool(world.pose("bar").position[2] > COUNTER + 0.06 and world.contacts("bar", ROBOT))


def _passed(world: World) -> bool:
    """Whether the hand on the rack's side alone holds the bar."""
    hands = {contact.link_b[0] for contact in world.contacts("bar", ROBOT)}
    return hands == {side_of(world.pose("rack"))[0]}


def _script(rest: Rest) -> tuple[Primitive, ...]:
    """For each step the primitive of either hand; one of the two is passed over."""
    steps = (partial(pick, rest=rest), bring, take, release, partial(carry, rest=rest), partial(insert, rest=rest))
    last = retract("retract", rest.frames[2]).needing(Need("bar in the rack", lambda scene: in_rack(scene, rest)))
    return (*(step(side) for step in steps for side in SIDES), last)


def make_task(upright: float = 0.0) -> Task:
    """The task with a rack in which the bar lies flat (0) or stands upright (1).

    Raises:
        ValueError: ``upright`` is neither 0 nor 1.
    """
    if upright not in (0.0, 1.0):
        raise ValueError(f"upright must be 0 or 1, got {upright:g}")
    return make_scene({}, upright=bool(upright))


def make_scene(values: Values, upright: bool = False) -> Task:
    """The task for some values of its factors."""
    rest, length, height = (
        REST[upright],
        LENGTH * values.get("size", 1.0),
        RACK_HEIGHT[upright] + values.get("rack_height", 0.0),
    )
    dx, dy, yaw = values.get("rack:x", 0.0), values.get("rack:y", 0.0), math.radians(values.get("yaw", 0.0))
    attributes, script = {"bar.length": length, "rack.height": height}, _script(rest)
    return Task(
        name="handover",
        description=f"Pass the bar from one hand to the other and {'stand' if upright else 'lay'} it in the rack.",
        bodies=(BENCH, _COUNTER, _bar(values), (_socket if upright else _cradle)(height)),
        placements={
            BENCH.name: BENCH_PLACEMENT,
            _COUNTER.name: fixed((0.58, 0.0, 0.0)),
            "bar": _either_side(BAR_X, BAR_Y, COUNTER + THICKNESS / 2, yaw, YAW),
            "rack": _either_side(
                (RACK_X[0] + dx, RACK_X[1] + dx), (RACK_Y[0] + dy, RACK_Y[1] + dy), COUNTER, OUTWARD if upright else 0.0
            ),
        },
        observed=("bar", "rack"),
        attributes=tuple(attributes.items()),
        primitives=script,
        recovery=(retract("retract", told=False),),
        success=(
            Condition(
                "bar in the rack",
                lambda world: rest.reached(world.pose("bar"), world.pose("rack"), rest.middle(attributes)),
            ),
            at_rest("bar"),
            touching("bar", "rack"),
            not_touching("bar", ROBOT),
        ),
        stages=(
            Stage("picked", (Condition("bar raised", _held_up),)),
            Stage("handed over", (Condition("bar in the receiver's hand alone", _passed),)),
        ),
        dwell=9,
        # An anchored contact keeps the normal that it had first. After the hand has turned by a right angle, that points along
        # the bar, and the flat pads of the left hand stick to it when they open (in one episode of fifteen; without anchors in
        # none of 80). From the half-round pads of the right hand, which do not stick, the bar would turn away without them.
        anchored_hands=("right",),
        factors=FACTORS,
        events=EVENTS,
        vary=partial(make_scene, upright=upright),
        arrange=_opposite,
        length=sum(primitive.frames for primitive in script[:-1]) // 2 + script[-1].frames,
    )


TASK = make_task()
