"""Clear and lift: table lift, where a canister may be in the way. The hand that is nearer puts it aside first.

In a quarter of the scenes the canister stands on the platform, in the way of the table, which would shove it about. In a
quarter it stands on the table. In the others it stands aside on the bench already, and must be left alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose, about_z, geodesic_distance
from hdril.simulation.actions import HandCommand
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.robots.spec import OTHER, SIGN
from hdril.simulation.world import ROBOT, World
from hdril.tasks import table_lift
from hdril.tasks.bench import BENCH
from hdril.tasks.conditions import Condition, Stage
from hdril.tasks.factors import Factor
from hdril.tasks.primitives import Hands, Need, Primitive, Scene, Segment
from hdril.tasks.table_lift import DEPTH, PLATFORM_DEPTH, PLATFORM_HEIGHT, PLATFORM_X, TOP, WIDTH
from hdril.tasks.task import Task, Uniform, Values

EDGE, FOOT, NECK = 0.12, 0.10, 0.06
"""Width and height of the canister's foot, and width of its neck. Its weight is low, so that it lands upright if it falls."""
SHOULDER, POST, HEIGHT, GRIP_HEIGHT = 0.24, 0.03, 0.35, 0.31
"""The post on top is thinner than the jaws are wide, and square: it can be taken from any of four headings."""
PAD = 0.015
"""The middle of the fingers' pads is so far behind the tool's origin, m."""
MASS = 0.35
SHOULDER_Y = 0.26
"""How far a shoulder is from the robot's middle, m."""
ASIDE = (0.50, 0.82)
"""Where the canister is put, x and |y|, m."""
TRANSIT = 0.43
"""Height of the canister's foot, m, when it is carried: over the handles of the table."""
HOME = (0.56, 0.46, 0.47)
"""Where a hand goes that has put the canister aside: (x, |y|, z), m."""
CLEARANCE = 0.095
"""Least distance, m, of the canister's axis from the table's board if it stands on the platform."""
FARTHEST = 0.98
"""The canister stands no further away, x, m: beyond it no hand reaches down to it."""

GREEN, DARK = (0.36, 0.55, 0.40, 1.0), (0.20, 0.30, 0.24, 1.0)

FACTORS = (
    Factor("box_yaw", "offset", 15.0, 30.0, "deg", "the canister's heading, beside the nominal 15 deg"),
    Factor("box_mass", "ratio", 2.0, 3.0, "", "the canister's mass"),
)

# ---------------------------------------------------------------------- scene


_SHAPE = (
    Box((EDGE, EDGE, FOOT), (0.0, 0.0, FOOT / 2), GREEN),
    Box((NECK, NECK, SHOULDER - FOOT), (0.0, 0.0, (FOOT + SHOULDER) / 2), GREEN),
    Box((POST, POST, HEIGHT - SHOULDER), (0.0, 0.0, (SHOULDER + HEIGHT) / 2), DARK),
)


def _box(values: Values) -> BodySpec:
    # With a friction of 0.8 it tips over on a table that is pushed; with 0.5 it slides.
    return BodySpec("box", _SHAPE, mass=MASS * values.get("box_mass", 1.0), friction=0.5)


_YAW = math.radians(15.0)
_ASIDE_X, _ASIDE_Y = (0.45, 0.56), (0.78, 0.86)
_ON_PLATFORM_X = (PLATFORM_X - PLATFORM_DEPTH / 2 + 0.05, PLATFORM_X - PLATFORM_DEPTH / 2 + 0.13)
_ON_PLATFORM_Y = (0.05, 0.38)
_ON_TABLE_X, _ON_TABLE_Y = (0.0, 0.10), 0.25
_NEAREST = 0.57
"""On the table the canister stands no nearer, x, m: a hand that is near and high cannot point down."""
_TABLE_X, _TABLE_Y = (0.50, 0.60), (-0.20, 0.20)


@dataclass(frozen=True)
class InTheWayOrAside(Uniform):
    """Where the canister stands if table and platform are where they are by default.

    Aside (as likely as not), on the platform or on the table, on the left or on the right.
    """

    def sample(self, rng: np.random.Generator) -> Pose:
        case, sign = int(rng.integers(4)), rng.choice((-1.0, 1.0))
        across, along, turn = rng.uniform(size=3)
        (x, y, z) = (
            (_ASIDE_X, _ASIDE_Y, 0.0),
            (_ASIDE_X, _ASIDE_Y, 0.0),
            (_ON_PLATFORM_X, _ON_PLATFORM_Y, PLATFORM_HEIGHT),
            (_ON_TABLE_X, (0.0, _ON_TABLE_Y), TOP),
        )[case]
        position = (x[0] + along * (x[1] - x[0]), sign * (y[0] + across * (y[1] - y[0])), z)
        return Pose(position, about_z(self.yaw + (2.0 * turn - 1.0) * _YAW))


def _distance_from_board(point: NDArray[np.float64], table: Pose, values: Values) -> float:
    """Distance of a point from the table's board, seen from above, m."""
    x, y, _ = (table.inverse() @ Pose(point)).position
    depth, length = DEPTH * values.get("size:depth", 1.0), WIDTH * values.get("size:length", 1.0)
    return math.hypot(max(abs(x) - depth / 2, 0.0), max(abs(y) - length / 2, 0.0))


def _on_platform(box: Pose, platform: Pose, table: Pose, values: Values) -> NDArray[np.float64]:
    """On the platform as it stands, at least :data:`CLEARANCE` behind the table if there is room for it."""
    front = platform.position[0] - PLATFORM_DEPTH / 2
    height = PLATFORM_HEIGHT + values.get("platform_height", 0.0)
    low = front + 0.05  # 1 cm of its foot is over the edge
    high = max(low + 0.001, min(front + 0.14, FARTHEST))
    places = [np.array((x, box.position[1], height)) for x in np.arange(low, high, 0.005)]
    free = [place for place in places if _distance_from_board(place, table, values) >= CLEARANCE] or places[-1:]
    fraction = (box.position[0] - _ON_PLATFORM_X[0]) / (_ON_PLATFORM_X[1] - _ON_PLATFORM_X[0])
    return free[0] + fraction * (free[-1] - free[0])


def _on_table(box: Pose, table: Pose, values: Values) -> NDArray[np.float64]:
    """On the table as it stands: within 25 cm of the robot's middle, and at least 14 cm before the table's ends."""
    (x, y, _), (cosine, sine) = table.position, table.rotation_matrix()[:2, 0]
    depth, slope = values.get("size:depth", 1.0) / cosine, sine / cosine
    room = (WIDTH / 2 - 0.14) * values.get("size:length", 1.0) * cosine
    low, high = max(-_ON_TABLE_Y, y - room), min(_ON_TABLE_Y, y + room)
    # Where the table is turned, one end of it is too near.
    if slope > 0.0:
        high = min(high, y + (x + _ON_TABLE_X[1] * depth - _NEAREST) / slope)
    elif slope < 0.0:
        low = max(low, y + (x + _ON_TABLE_X[1] * depth - _NEAREST) / slope)
    across = low + (box.position[1] + _ON_TABLE_Y) / (2.0 * _ON_TABLE_Y) * (high - low)
    front, rear = (x - (across - y) * slope + edge * depth for edge in _ON_TABLE_X)
    front, fraction = max(front, _NEAREST), box.position[0] / _ON_TABLE_X[1]
    return np.array((front + fraction * (rear - front), across, TOP))


def _arrange(values: Values, poses: dict[str, Pose]) -> dict[str, Pose]:
    """The canister moved with what it stands on."""
    box, table = poses["box"], poses["table"]
    if box.position[2] == PLATFORM_HEIGHT:
        return poses | {"box": Pose(_on_platform(box, poses["platform"], table, values), box.quaternion)}
    if box.position[2] == TOP:
        return poses | {"box": Pose(_on_table(box, table, values), box.quaternion)}
    return poses


def admissible(poses: dict[str, Pose], values: Values) -> bool:
    """Whether a table can stand so, and the canister stands on the table or beside it."""
    box = poses["box"].position
    beside = box[2] == TOP or _distance_from_board(box, poses["table"], values) >= CLEARANCE - 1e-9
    return table_lift.admissible(poses, values) and beside


def _put_aside(world: World) -> bool:
    """Whether the canister is on the bench and nothing touches it. Behind the platform's front, the table has shoved it there."""
    others = ("table", "platform", ROBOT)
    on_bench = world.contacts("box", BENCH.name) and not any(world.contacts("box", other) for other in others)
    return bool(on_bench and before(world.pose("box"), world.pose("platform")))


def before(box: Pose, platform: Pose) -> bool:
    """Whether the canister's foot is on the robot's side of the platform's front."""
    return bool(box.position[0] < platform.position[0] - PLATFORM_DEPTH / 2)


def _where_it_stood(world: World) -> bool:
    """Whether a canister that stood aside from the beginning is there still: within 1 cm and 0.1 rad."""
    before, now = world.placed("box"), world.pose("box")
    near = np.linalg.norm(now.position - before.position) < 0.01
    return bool(before.position[2] > 0.0 or (near and geodesic_distance(now.quaternion, before.quaternion) < 0.1))


BOX_ASIDE = Condition("box on bench before the platform, free of all else", _put_aside)
BOX_LEFT = Condition("box that stood aside left there", _where_it_stood)

# ---------------------------------------------------------------------- what is seen


def lowest(box: Pose) -> float:
    """Height of the lowest corner of the canister, m."""
    vertical = box.rotation_matrix()[2]
    return float(box.position[2] + min(vertical @ part.centre - 0.5 * np.abs(vertical) @ part.size for part in _SHAPE))


def aside(scene: Scene) -> bool:
    """Whether the canister is on the bench, before the platform."""
    return lowest(scene.objects["box"]) < 0.03 and before(scene.objects["box"], scene.objects["platform"])


def holds_box(scene: Scene, side: str) -> bool:
    """Whether a hand was told to close, is not empty, and has the post between its fingers."""
    hand = scene.measured[side]
    near = np.linalg.norm(hand.pose.position - _grip_point(scene.objects["box"])) < 0.04
    return bool(scene.hands[side].opening < 0.5 and hand.opening > 0.08 and near)


def concerns(scene: Scene, side: str) -> bool:
    """Whether it is for this hand to put the canister aside: it has it, or it is nearer and the other has not."""
    nearer = SIGN[side] * scene.objects["box"].position[1] >= 0.0
    return holds_box(scene, side) or (nearer and not holds_box(scene, OTHER[side]))


ASIDE_NEED = Need("box aside", aside)
IN_THE_WAY = Need("box in the way", lambda scene: not aside(scene))

# ---------------------------------------------------------------------- script


def _grip_point(box: Pose) -> NDArray[np.float64]:
    return (box @ Pose((0.0, 0.0, GRIP_HEIGHT))).position


def _tool(pitch: float, heading: float) -> Rotation:
    """A hand that points down by ``pitch`` and turned about z by ``heading``, rad, jaws level."""
    c, s = math.cos(pitch), math.sin(pitch)
    return Rotation.from_euler("z", heading) * Rotation.from_matrix(np.array(((-s, 0, c), (0, 1, 0), (-c, 0, -s))))


def _grip(scene: Scene, side: str) -> Pose:
    """A hand at the post, jaws across it.

    It is the steeper the nearer it is, because a hand that is near and high cannot be flat. Where the post is far, the hand is
    turned up to 10 degrees towards the way the arm points: the jaws are wide enough for that.
    """
    box = scene.objects["box"]
    point, axes = _grip_point(box), box.rotation_matrix()
    if axes[2, 2] > 0.7:
        heading = math.remainder(math.atan2(axes[1, 0], axes[0, 0]), math.pi / 2)
        arm = SIGN[side] * math.atan2(SIGN[side] * point[1] - SHOULDER_Y, point[0])
        most = math.radians(float(np.interp(point[0], (0.85, 0.92), (0.0, 10.0))))
        heading += min(most, max(-most, arm - heading))
        pitch = math.radians(float(np.interp(point[0], (0.60, 0.85), (65.0, 45.0))))
    else:  # lying: from above, jaws across the post
        heading = math.remainder(math.atan2(axes[1, 2], axes[0, 2]), math.pi)
        pitch = math.radians(80.0)
    return Pose(point, _tool(pitch, heading).as_quat()) @ Pose((0.0, 0.0, PAD))


def _at_post(side: str, opening: float, back_off: float = 0.0) -> Callable[[Scene], Hands]:
    def goal(scene: Scene) -> Hands:
        return scene.hands | {side: HandCommand(_grip(scene, side) @ Pose((0.0, 0.0, -back_off)), opening)}

    return goal


def _lifted(side: str) -> Callable[[Scene], Hands]:
    """The hand raised, so that the canister's foot is at :data:`TRANSIT`."""

    def goal(scene: Scene) -> Hands:
        rise = max(0.0, TRANSIT - lowest(scene.objects["box"]))
        return scene.hands | {side: HandCommand(_grip(scene, side).translated((0.0, 0.0, rise)), 0.0)}

    return goal


def _carried(side: str, foot: float, opening: float, back_off: float = 0.0) -> Callable[[Scene], Hands]:
    """The hand over :data:`ASIDE`, turned outwards, the canister's foot at height ``foot``."""

    def goal(scene: Scene) -> Hands:
        hand, box = scene.hands[side].pose, scene.objects["box"]
        jaws = hand.rotation_matrix()[:, 1]
        turn = SIGN[side] * math.radians(35.0) - math.atan2(-jaws[0], jaws[1])
        rotation = Rotation.from_euler("z", turn) * Rotation.from_quat(hand.quaternion)
        height = hand.position[2] - lowest(box) + foot
        pose = Pose((ASIDE[0], SIGN[side] * ASIDE[1], height), rotation.as_quat())
        return scene.hands | {side: HandCommand(pose @ Pose((0.0, 0.0, -back_off)), opening)}

    return goal


def _home(side: str) -> Callable[[Scene], Hands]:
    x, y, z = HOME
    pose = Pose((x, SIGN[side] * y, z), _tool(math.radians(45.0), 0.0).as_quat())
    return lambda scene: scene.hands | {side: HandCommand(pose, 1.0)}


def pick(side: str) -> Primitive:
    """Come to the post from above, take it, and lift the canister."""
    box = ("box",)
    return Primitive(
        f"pick_{side}",
        (
            Segment(12, _at_post(side, 1.0, back_off=0.10), follows=box),
            Segment(4, _at_post(side, 1.0), jitter=0.25, follows=box),
            Segment(2, _at_post(side, 0.0), jitter=0.0),
            Segment(8, _lifted(side), jitter=0.5),
        ),
    ).needing(unless=Need(f"not for the {side} hand", lambda scene: aside(scene) or not concerns(scene, side)))


def put(side: str) -> Primitive:
    """Carry the canister to the bench at the hand's side, set it down, let go, and come back."""
    return Primitive(
        f"put_{side}",
        (
            Segment(14, _carried(side, TRANSIT, 0.0), jitter=0.5),
            Segment(12, _carried(side, 0.002, 0.0), jitter=0.5),
            Segment(2, _carried(side, 0.002, 1.0), jitter=0.0),
            Segment(4, _carried(side, 0.002, 1.0, back_off=0.12), jitter=0.25),
            Segment(7, _home(side)),
        ),
    ).needing(
        Need(f"{side} hand holds box", lambda scene: holds_box(scene, side) or aside(scene)),
        unless=Need(f"not for the {side} hand", lambda scene: aside(scene) or not concerns(scene, side)),
    )


CLEARING = (pick("left"), put("left"), pick("right"), put("right"))
PICK_AND_PUT = CLEARING[0].frames + CLEARING[1].frames


def make_scene(values: Values) -> Task:
    """The task for some values of its factors."""
    lift = table_lift.make_scene(values)
    grasp, *rest = lift.primitives
    yaw = math.radians(values.get("box_yaw", 0.0))
    bounds = ((_ASIDE_X[0], -_ASIDE_Y[1], 0.0), (_ON_PLATFORM_X[1], _ASIDE_Y[1], TOP))
    table = lift.placements["table"]
    return replace(
        lift,
        name="clear_and_lift",
        description="Put the canister aside if it is in the way, then lift the table with both hands onto the platform.",
        bodies=(*lift.bodies, _box(values)),
        placements=lift.placements
        | {
            "table": Uniform((_TABLE_X[0], _TABLE_Y[0], 0.0), (_TABLE_X[1], _TABLE_Y[1], 0.0), table.yaw),
            "box": InTheWayOrAside(*bounds, yaw),
        },
        arrange=partial(_arrange, values),
        observed=("table", "box"),
        primitives=(
            *CLEARING,
            replace(grasp, unless=IN_THE_WAY),
            *(replace(p, needs=(*p.needs, ASIDE_NEED)) if p.name in ("move", "lift") else p for p in rest),
        ),
        length=lift.horizon,
        longest=lift.horizon + PICK_AND_PUT,
        success=(*lift.success, BOX_ASIDE, BOX_LEFT),
        stages=(Stage("box aside", (BOX_ASIDE,)), *lift.stages),
        factors=(*lift.factors, *FACTORS),
        vary=make_scene,
        admissible=admissible,
    )


TASK = make_scene({})
