"""Handover: a bar lies on one side of a counter and belongs into a rack on the other; one hand passes it to the other.

Which side the bar lies on is drawn. The hand on that side is the giver: the rack is out of its reach. The other, the receiver,
cannot reach the bar where it lies. A planner has to see which hand picks; a wrong one closes on nothing.
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
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.robots.spec import SIDES
from hdril.simulation.world import ROBOT, World
from hdril.tasks.bench import BENCH, BENCH_PLACEMENT
from hdril.tasks.conditions import Condition, Stage, at_rest, not_touching, touching
from hdril.tasks.events import EventSpec
from hdril.tasks.factors import Factor
from hdril.tasks.primitives import Hands, Need, Primitive, Scene, Segment
from hdril.tasks.task import Task, Uniform, Values, fixed

LENGTH, THICKNESS, MASS = 0.34, 0.03, 0.25
COUNTER = 0.18
"""Height of the counter. On the bench itself, 1.1 m below the shoulders, no hand can point down."""
RACK_HEIGHT, POST, SLACK = 0.06, 0.05, 0.010
POST_X = 0.04
BAR_X, BAR_Y = (0.46, 0.56), (0.56, 0.64)
RACK_X, RACK_Y = (0.48, 0.54), (0.54, 0.60)
YAW = math.radians(15.0)
MEET_X, MEET_Z = 0.52, 0.36
GRIP = 0.25
"""Where a hand holds the bar, from its middle, as a part of its length: further out, a heavy bar turns in the fingers."""
GRIP_DEPTH = 0.005
"""How far the tool's origin is below the bar's axis: the finger tips then end 6 mm over what it lies on."""

WOOD, STEEL, GREY = (0.80, 0.62, 0.42, 1.0), (0.35, 0.42, 0.50, 1.0), (0.75, 0.76, 0.78, 1.0)
SIGN = dict(zip(SIDES, (1.0, -1.0), strict=True))
"""Of the y axis, on the side of a hand."""
OTHER = dict(zip(SIDES, reversed(SIDES), strict=True))

FACTORS = (
    Factor("yaw", "offset", 30.0, 45.0, "deg", "the bar's heading, beside the nominal 15 deg"),
    Factor("size", "scale", 0.15, 0.25, "", "length of the bar"),
    Factor("mass", "ratio", 2.0, 3.0, "", "the bar's mass"),
    Factor("friction", "scale", 0.4, 0.6, "", "friction of the bar on counter, rack and pads"),
    Factor("rack", "offset", 0.10, 0.12, "m", "where the rack stands", ("x", "y")),
    Factor("rack_height", "offset", 0.04, 0.05, "m", "how high the rack is"),
)

ARM_JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in ("s1", "e1", "w1"))
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
        half = 0.5 * (self.yaw + rng.uniform(-self.spread, self.spread))
        return Pose((x, sign * y, self.low[2]), (0.0, 0.0, sign * math.sin(half), math.cos(half)))


def _either_side(
    x: tuple[float, float], y: tuple[float, float], z: float, yaw: float = 0.0, spread: float = 0.0
) -> EitherSide:
    return EitherSide((x[0], -y[1], z), (x[1], y[1], z), yaw, near=y[0], spread=spread)


def _opposite(poses: dict[str, Pose]) -> dict[str, Pose]:
    """The rack on the side where the bar does not lie."""
    x, y, z = poses["rack"].position
    return poses | {"rack": Pose((x, -math.copysign(y, poses["bar"].position[1]), z))}


def _bar(values: Values) -> BodySpec:
    return BodySpec(
        "bar",
        (Box((LENGTH * values.get("size", 1.0), THICKNESS, THICKNESS), (0.0, 0.0, 0.0), WOOD),),
        mass=MASS * values.get("mass", 1.0),
        friction=0.8 * values.get("friction", 1.0),
    )


def _rack(height: float) -> BodySpec:
    """A block with two pairs of posts on it; the bar lies between them along x."""
    y = THICKNESS / 2 + SLACK + 0.01
    return BodySpec(
        "rack",
        (
            Box((0.16, 0.11, height), (0.0, 0.0, height / 2), STEEL),
            *(
                Box((0.02, 0.02, POST), (a * POST_X, b * y, height + POST / 2), STEEL)
                for a in (-1.0, 1.0)
                for b in (-1.0, 1.0)
            ),
        ),
    )


# ---------------------------------------------------------------------- what is seen


def _side_of(pose: Pose) -> str:
    return "left" if pose.position[1] > 0.0 else "right"


def receiver(scene: Scene) -> str:
    """The hand on the rack's side."""
    return _side_of(scene.objects["rack"])


def _along(pose: Pose) -> NDArray[np.float64]:
    """Unit vector (3,) along the bar."""
    return pose.rotation_matrix()[:, 0]


def holds_bar(scene: Scene, side: str) -> bool:
    """Whether a hand was told to close, is not empty, and has the bar between its fingers."""
    hand = scene.measured[side]
    local = (scene.objects["bar"].inverse() @ hand.pose).position
    inside = abs(local[0]) < scene.attributes["bar.length"] / 2 + 0.01 and math.hypot(local[1], local[2]) < 0.03
    return bool(scene.hands[side].opening < 0.5 and hand.opening > 0.2 and inside)


def _in_rack(bar: Pose, rack: Pose, height: float, length: float) -> bool:
    """Whether the bar lies between the posts, on the block, level, and not more than 3 cm off along it."""
    x, y, z = (rack.inverse() @ bar).position
    axis = _along(bar)
    return bool(
        abs(x) < 0.03 and abs(y) < 0.012 and abs(z - height - THICKNESS / 2) < 0.01 and abs(axis[0]) > math.cos(0.1)
    )


def in_rack(scene: Scene) -> bool:
    """Whether the bar lies in the rack."""
    height, length = scene.attributes["rack.height"], scene.attributes["bar.length"]
    return _in_rack(scene.objects["bar"], scene.objects["rack"], height, length)


def at_meeting(scene: Scene) -> bool:
    """Whether the bar is held up in the middle, across."""
    bar = scene.objects["bar"]
    offset = bar.position - (MEET_X, 0.0, MEET_Z)
    return bool(np.linalg.norm(offset) < 0.08 and abs(_along(bar)[1]) > 0.9)


def over_rack(scene: Scene) -> bool:
    """Whether the bar is over the rack and along it."""
    bar, rack = scene.objects["bar"], scene.objects["rack"]
    x, y, _ = bar.position - rack.position
    return bool(abs(x) < 0.04 and abs(y) < 0.03 and abs(_along(bar)[0]) > 0.98)


# ---------------------------------------------------------------------- grips and places


def _heading(side: str, free: NDArray[np.float64]) -> float:
    """Heading of the hand whose bar extends along ``free``, rad: 0 if that is forward; inwards is negative on both sides."""
    return SIGN[side] * math.atan2(free[1], free[0])


PREFERRED = math.radians(-30.0)
"""The heading in the middle of those that a hand is turned to: -90 deg where the bar is passed, 0 at the rack."""


def held_end(scene: Scene, side: str) -> float:
    """The end, 1 or -1 along the bar, that a hand takes to pick the bar up: the one that turns the wrist less."""
    axis = _along(scene.objects["bar"])

    def turn(end: float) -> float:
        return abs(math.remainder(_heading(side, -end * axis) - PREFERRED, 2.0 * math.pi))

    return min((1.0, -1.0), key=turn)


def free_end(scene: Scene, side: str) -> float:
    """The end that the other hand does not hold."""
    bar, other = scene.objects["bar"], scene.measured[OTHER[side]].pose
    return -math.copysign(1.0, (bar.inverse() @ other).position[0])


def _grip(scene: Scene, end: float) -> Pose:
    """A tool that points down at an end of the bar, jaws across it."""
    bar = scene.objects["bar"]
    x = end * _along(bar)  # tool x points away from the bar's free end
    return Pose(bar.position + GRIP * scene.attributes["bar.length"] * x, _pointing_down(x)) @ Pose(
        (0.0, 0.0, GRIP_DEPTH)
    )


def _pointing_down(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orientation (4,) of a tool with this x axis (unit, 3) whose z axis is as near to straight down as it can be."""
    z = np.array((0.0, 0.0, -1.0)) + x[2] * x
    z /= np.linalg.norm(z)
    return Rotation.from_matrix(np.stack((x, np.cross(z, x), z), axis=1)).as_quat()


def _level(bar: Pose, axis: NDArray[np.float64], position: NDArray[np.float64]) -> Pose:
    """The bar with its x axis along ``axis`` (horizontal), the side up that is up now, at ``position``."""
    vertical = bar.rotation_matrix()[2]
    up = 1 + int(np.abs(vertical[1:]).argmax())
    columns = np.zeros((3, 3))
    columns[:, 0], columns[2, up] = axis, math.copysign(1.0, vertical[up])
    rest = 3 - up
    columns[:, rest] = np.cross(columns[:, (rest + 1) % 3], columns[:, (rest + 2) % 3])
    return Pose(position, Rotation.from_matrix(columns).as_quat())


def _carried(side: str, target: Callable[[Scene], tuple[NDArray[np.float64], NDArray[np.float64]]]):
    """The hand with the bar: its free end along the first of ``target(scene)``, its middle at the second."""

    def goal(scene: Scene) -> Hands:
        bar, hand = scene.objects["bar"], scene.hands[side]
        free, position = target(scene)
        end = math.copysign(1.0, (bar.inverse() @ scene.measured[side].pose).position[0])
        motion = _level(bar, -end * free, position) @ bar.inverse()
        return scene.hands | {side: HandCommand(motion @ hand.pose, hand.opening)}

    return goal


def _meeting(side: str) -> Callable[[Scene], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    return lambda scene: (np.array((0.0, -SIGN[side], 0.0)), np.array((MEET_X, 0.0, MEET_Z)))


def _at_rack(above: float) -> Callable[[Scene], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    def target(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        height = scene.attributes["rack.height"] + THICKNESS / 2 + above
        return np.array((1.0, 0.0, 0.0)), scene.objects["rack"].position + np.array((0.0, 0.0, height))

    return target


def _ready(side: str) -> HandCommand:
    """An open hand beside the place where the bar is passed, higher than it."""
    turn = _pointing_down(np.array((0.0, SIGN[side], 0.0)))
    return HandCommand(Pose((MEET_X, SIGN[side] * 0.28, MEET_Z + 0.14), turn), 1.0)


# ---------------------------------------------------------------------- primitives


def _at_end(side: str, end: Callable[[Scene, str], float], opening: float, above: float = 0.0):
    """One hand at an end of the bar, ``above`` metres over its grip; the other stays."""

    def goal(scene: Scene) -> Hands:
        tool = _grip(scene, end(scene, side)).translated((0.0, 0.0, above))
        return scene.hands | {side: HandCommand(tool, opening)}

    return goal


def _raised(side: str, opening: float | None, above: float, aside: bool = False):
    """One hand where it was told to be and ``above`` metres higher; or at its ready place."""

    def goal(scene: Scene) -> Hands:
        hand = scene.hands[side]
        raised = HandCommand(hand.pose.translated((0.0, 0.0, above)), hand.opening if opening is None else opening)
        return scene.hands | {side: _ready(side) if aside else raised}

    return goal


def pick(side: str) -> Primitive:
    """Take the bar where it lies, at the end that turns the wrist less."""
    return Primitive(
        f"pick_{side}",
        (
            Segment(8, _at_end(side, held_end, 1.0, above=0.10), follows=("bar",)),
            Segment(4, _at_end(side, held_end, 1.0), jitter=0.25, follows=("bar",)),
            Segment(2, _at_end(side, held_end, 0.0), jitter=0.0),
        ),
        unless=_need("bar on the other side, held or in the rack", lambda scene: not _lies(scene, side)),
    )


def bring(side: str) -> Primitive:
    """Lift the bar and hold it across the middle, while the receiver gets ready."""
    meet = _carried(side, _meeting(side))

    def both(scene: Scene) -> Hands:
        return meet(scene) | {OTHER[side]: _ready(OTHER[side])}

    return Primitive(
        f"bring_{side}",
        (Segment(4, _raised(side, None, 0.08), jitter=0.25), Segment(10, both)),
        needs=(_held(side),),
        unless=_need("not the giver, or the receiver holds the bar", lambda scene: not _gives(scene, side)),
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
        needs=(_held(OTHER[side]), _need("bar in the middle", at_meeting)),
        unless=_need("not the receiver, or holds the bar", lambda scene: not _gives(scene, OTHER[side])),
    )


def release(side: str) -> Primitive:
    """The giver opens its hand, rises, and gets out of the way."""
    return Primitive(
        f"release_{side}",
        (
            Segment(2, _raised(side, 1.0, 0.0), jitter=0.0),
            Segment(3, _raised(side, 1.0, 0.12), jitter=0.25),
            Segment(3, _raised(side, 1.0, 0.0, aside=True), jitter=0.25),
        ),
        needs=(_held(OTHER[side]),),
        unless=_need("not the giver, or away from the bar", lambda s: receiver(s) == side or not _near(s, side)),
    )


def carry(side: str) -> Primitive:
    """Bring the bar over the rack, along it."""
    return Primitive(
        f"carry_{side}",
        (Segment(12, _carried(side, _at_rack(above=0.12)), follows=("rack",)),),
        needs=(_held(side), _need("giver away from the bar", lambda scene: not _near(scene, OTHER[side]))),
        unless=_need("not the receiver, or the bar in the rack", lambda s: receiver(s) != side or in_rack(s)),
    )


def insert(side: str) -> Primitive:
    """Lower the bar between the posts."""
    return Primitive(
        f"insert_{side}",
        (Segment(7, _carried(side, _at_rack(above=0.0)), jitter=0.25, follows=("rack",)),),
        needs=(_held(side), _need("bar over the rack", over_rack)),
        unless=_need("not the receiver, or the bar in the rack", lambda s: receiver(s) != side or in_rack(s)),
    )


def retract(name: str, frames: int = 8) -> Primitive:
    """Open both hands and raise them."""

    def goal(rise: float) -> Callable[[Scene], Hands]:
        return lambda scene: {
            side: HandCommand(hand.pose.translated((0.0, 0.0, rise)), 1.0) for side, hand in scene.hands.items()
        }

    return Primitive(name, (Segment(2, goal(0.0), jitter=0.0), Segment(frames - 2, goal(0.12), jitter=0.25)))


def _need(name: str, holds: Callable[[Scene], bool]) -> Need:
    return Need(name, holds)


def _held(side: str) -> Need:
    return Need(f"{side} hand holds the bar", lambda scene: holds_bar(scene, side))


def _near(scene: Scene, side: str) -> bool:
    """Whether a hand is so near to the bar that it may touch it."""
    x, y, z = (scene.objects["bar"].inverse() @ scene.measured[side].pose).position
    return bool(abs(x) < scene.attributes["bar.length"] / 2 + 0.05 and math.hypot(y, z) < 0.08)


def _lies(scene: Scene, side: str) -> bool:
    """Whether the bar waits to be picked up by a hand."""
    held = any(holds_bar(scene, each) for each in SIDES)
    return _side_of(scene.objects["bar"]) == side and not held and not in_rack(scene)


def _gives(scene: Scene, side: str) -> bool:
    """Whether a hand is the giver, and the receiver does not hold the bar yet."""
    return receiver(scene) != side and not holds_bar(scene, OTHER[side])


# ---------------------------------------------------------------------- success


def _in_rack_condition(height: float, length: float) -> Condition:
    return Condition("bar in the rack", lambda world: _in_rack(world.pose("bar"), world.pose("rack"), height, length))


def _held_up(world: World) -> bool:
    return bool(world.pose("bar").position[2] > COUNTER + 0.06 and world.contacts("bar", ROBOT))


def _passed(world: World) -> bool:
    """Whether the hand on the rack's side alone holds the bar."""
    side = _side_of(world.pose("rack"))
    links = {contact.link_b[0] for contact in world.contacts("bar", ROBOT)}
    return links == {side[0]}


def admissible(poses: dict[str, Pose], values: Values) -> bool:
    """Whether the bar is out of the receiver's reach, and the giver's end of it within the giver's."""
    return True


def make_scene(values: Values) -> Task:
    """The task for some values of its factors."""
    length, height = LENGTH * values.get("size", 1.0), RACK_HEIGHT + values.get("rack_height", 0.0)
    dx, dy, yaw = values.get("rack:x", 0.0), values.get("rack:y", 0.0), math.radians(values.get("yaw", 0.0))
    picked = Stage("picked", (Condition("bar raised", _held_up),))
    script = (
        *(pick(side) for side in SIDES),
        *(bring(side) for side in SIDES),
        *(take(side) for side in SIDES),
        *(release(side) for side in SIDES),
        *(carry(side) for side in SIDES),
        *(insert(side) for side in SIDES),
    )
    last = retract("retract").needing(_need("bar in the rack", in_rack))
    return Task(
        name="handover",
        description="Pass the bar from one hand to the other and lay it into the rack.",
        bodies=(
            BENCH,
            BodySpec("counter", (Box((0.60, 1.70, COUNTER), (0.0, 0.0, COUNTER / 2), GREY),), friction=0.5),
            _bar(values),
            _rack(height),
        ),
        placements={
            BENCH.name: BENCH_PLACEMENT,
            "counter": fixed((0.58, 0.0, 0.0)),
            "bar": _either_side(BAR_X, BAR_Y, COUNTER + THICKNESS / 2, yaw, YAW),
            "rack": _either_side((RACK_X[0] + dx, RACK_X[1] + dx), (RACK_Y[0] + dy, RACK_Y[1] + dy), COUNTER),
        },
        observed=("bar", "rack"),
        attributes=(("bar.length", length), ("rack.height", height)),
        primitives=(*script, last),
        recovery=(retract("retract"),),
        success=(
            _in_rack_condition(height, length),
            at_rest("bar"),
            touching("bar", "rack"),
            not_touching("bar", ROBOT),
        ),
        stages=(picked, Stage("handed over", (Condition("bar in the receiver's hand alone", _passed),))),
        dwell=9,
        factors=FACTORS,
        events=EVENTS,
        vary=make_scene,
        admissible=admissible,
        arrange=_opposite,
        length=sum(primitive.frames for primitive in script) // 2 + last.frames,
    )


TASK = make_scene({})
