"""Table lift (paper, Section 5.2): slide a table to the middle, lift it, and set it down on a platform.

Sizes and start area are the paper's (35 x 85 cm; 20 x 60 cm); mass, handles and platform are ours, chosen so that one
arm cannot do it and the jaws close on nothing but the handles.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose, about_z
from hdril.simulation.actions import HandCommand
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.robots.spec import SIDES, SIGN
from hdril.simulation.world import ROBOT
from hdril.tasks.bench import ARM_JOINTS, BENCH, BENCH_PLACEMENT
from hdril.tasks.conditions import Stage, at_height, at_rest, not_touching, raised, touching, upright
from hdril.tasks.events import EventSpec
from hdril.tasks.factors import Factor
from hdril.tasks.primitives import (
    Grip,
    Hands,
    Need,
    Primitive,
    Scene,
    carry,
    extend,
    grasp,
    holding,
    holds_grip,
    lift,
    move,
    retract,
    stands_at,
)
from hdril.tasks.task import Task, Uniform, Values, fixed

DEPTH, WIDTH, TOP = 0.35, 0.85, 0.30
BOARD = 0.06  # thicker than the jaws are wide, so that the board itself cannot be pinched
HANDLE_Y, GRIP_HEIGHT = 0.41, 0.355
LEG_X, LEG_Y, LEG = 0.10, 0.35, 0.04
PLATFORM_HEIGHT, PLATFORM_X, PLATFORM_DEPTH, PLATFORM_WIDTH = 0.12, 0.98, 0.30, 0.90
MOVED_X = 0.66

WOOD, DARK, STEEL = (0.80, 0.62, 0.42, 1.0), (0.45, 0.31, 0.20, 1.0), (0.35, 0.42, 0.50, 1.0)

FACTORS = (
    Factor("yaw", "offset", 30.0, 45.0, "deg", "the table's heading"),
    Factor("size", "scale", 0.15, 0.25, "", "length and depth of the table, its legs and handles with them",
           ("length", "depth")),
    Factor("mass", "ratio", 2.0, 3.0, "", "the table's mass"),
    Factor("friction", "scale", 0.4, 0.6, "", "friction of the table on bench, platform and pads"),
    Factor("platform", "offset", 0.10, 0.15, "m", "where the platform stands", ("x", "y")),
    Factor("platform_height", "offset", 0.04, 0.06, "m", "how high the platform is"),
)  # fmt: skip
EVENTS = (
    EventSpec("push", "push", (1, 9), ("table",), strength=(0.4, 1.25)),
    EventSpec("push_held", "push", (24, 48), ("table",), strength=(0.4, 1.25)),
    EventSpec("open_hand", "open_hand", (8, 46), SIDES, frames=(3, 6)),
    EventSpec("stop_motor", "stop_motor", (2, 50), ARM_JOINTS, frames=(5, 10)),
    EventSpec("platform_slide", "slide", (12, 40), ("platform",), frames=(8, 12), strength=(0.03, 0.06)),
    EventSpec("freeze", "freeze", (0, 50), frames=(5, 15)),
    EventSpec("repeat", "repeat", (0, 50), frames=(15, 30)),
)


def _table(values: Values) -> BodySpec:
    length, depth = values.get("size:length", 1.0), values.get("size:depth", 1.0)
    return BodySpec(
        "table",
        (
            Box((DEPTH * depth, WIDTH * length, BOARD), (0.0, 0.0, TOP - BOARD / 2), WOOD),
            *(
                Box((LEG, LEG, TOP - BOARD), (x, y, (TOP - BOARD) / 2), DARK)
                for x in (-LEG_X * depth, LEG_X * depth)
                for y in (-LEG_Y * length, LEG_Y * length)
            ),
            *(Box((0.08, 0.025, 0.09), (0.0, y, TOP + 0.045), DARK) for y in (-HANDLE_Y * length, HANDLE_Y * length)),
        ),
        # One arm can lift a table of 0.5 kg. Tests check that one arm fails at every mass that is drawn.
        mass=2.0 * values.get("mass", 1.0),
        friction=0.8 * values.get("friction", 1.0),
    )


def _platform_height(values: Values) -> float:
    return PLATFORM_HEIGHT + values.get("platform_height", 0.0)


def _platform(values: Values) -> BodySpec:
    height = _platform_height(values)
    return BodySpec("platform", (Box((PLATFORM_DEPTH, PLATFORM_WIDTH, height), (0.0, 0.0, height / 2), STEEL),))


def admissible(poses: dict[str, Pose], values: Values) -> bool:
    """Whether the table's legs stand beside the platform and not in it: at least 1 cm before its front edge."""
    table, front = poses["table"], poses["platform"].position[0] - PLATFORM_DEPTH / 2
    x = LEG_X * values.get("size:depth", 1.0) + LEG / 2
    y = LEG_Y * values.get("size:length", 1.0) + LEG / 2
    corners = [(table @ Pose((a, b, 0.0))).position[0] for a in (-x, x) for b in (-y, y)]
    return max(corners) < front - 0.01


# Hands pitched 45 degrees, down and forward, jaws across the handles.
_PITCH = Rotation.from_matrix(np.array([[-1, 0, 1], [0, np.sqrt(2), 0], [-1, 0, -1]]) / np.sqrt(2)).as_quat()
PITCH = 45.0


def _turned(degrees: float) -> Pose:
    """A turn about the jaws' axis, which pitches a hand down by ``degrees``."""
    half = 0.5 * math.radians(degrees)
    return Pose((0.0, 0.0, 0.0), (0.0, math.sin(half), 0.0, math.cos(half)))


def _pitch(hand: Pose) -> float:
    """How far a hand points down, deg."""
    return math.degrees(math.asin(min(1.0, max(-1.0, -hand.rotation_matrix()[2, 2]))))


def _ramp(value: float, start: float, end: float) -> float:
    """0 up to ``start``, 1 from ``end`` on, and linear between them."""
    return min(1.0, max(0.0, (value - start) / (end - start)))


def _grip(sign: float) -> Grip:
    """The handle on the table's left (1) or right (-1).

    Where the table stands nearly square, the hand is pitched down by 45 degrees. It is steeper at a handle that is turned
    towards the robot, which is too near for a flat hand. At one that is turned away and far aside, the jaws must point another
    way than the forearm: the hand is steeper there too, and turned outwards. Where the handle is turned away most, it is turned
    further outwards, as far as the jaws' width allows, and flatter: so it reaches furthest. There, and where the platform is far,
    it takes the end of the handle that is nearer to the robot.
    """

    def pose(scene: Scene) -> Pose:
        table, y = scene.objects["table"], sign * HANDLE_Y * (scene.attributes["table.length"] / WIDTH)
        yaw = sign * math.degrees(table.heading)
        aside = sign * (table @ Pose((0.0, y, GRIP_HEIGHT))).position[1]
        near = 30.0 * _ramp(yaw, 3.0, 10.0) + 5.0 * _ramp(yaw, 18.0, 28.0)
        away = _ramp(-yaw, 6.0, 11.0) * _ramp(aside, 0.36, 0.44)
        farthest = away * _ramp(-yaw, 18.0, 30.0)
        nearer = max(0.02 * away + 0.01 * farthest, 0.02 * _far(scene))
        grip = Pose((-nearer, y, GRIP_HEIGHT), _PITCH)
        if away:
            outwards = Pose((0, 0, 0), about_z(sign * math.radians(20.0 * (away + farthest))))
            grip = Pose(grip.position, (outwards @ grip).quaternion)
        return grip @ _turned(near + 13.0 * (away - farthest)) if near or away else grip

    return Grip("table", pose)


GRIPS = {side: _grip(sign) for side, sign in SIGN.items()}
HELD = holding(GRIPS)


def height_of_platform(scene: Scene) -> float:
    """Height of the platform's top over the bench, m."""
    return scene.attributes["platform.height"]


def before_platform(scene: Scene) -> float:
    """Where a table that is square to the world stands, x, m, with its front legs 5 cm before the platform or further."""
    legs = LEG_X * scene.attributes["table.depth"] / DEPTH + LEG / 2
    front = scene.objects["platform"].position[0] - PLATFORM_DEPTH / 2
    return min(MOVED_X, front - legs - 0.05)


def _spare_x(scene: Scene) -> float:
    """How far the table may stand from the platform's middle, m, with the middles of its legs 5 mm from the edge."""
    return PLATFORM_DEPTH / 2 - LEG_X * scene.attributes["table.depth"] / DEPTH - 0.005


def _spare_y(scene: Scene) -> float:
    return PLATFORM_WIDTH / 2 - LEG_Y * scene.attributes["table.length"] / WIDTH - 0.005


def goal_x(scene: Scene) -> float:
    """Where the table goes on the platform, x, m: its middle, or nearer to the robot if the platform is far away.

    The middles of the front legs stay on the platform, 1 cm from its edge or more.
    """
    x = float(scene.objects["platform"].position[0])
    return x - min(max(x - PLATFORM_X, 0.0), _spare_x(scene) - 0.005)


def goal_y(scene: Scene) -> float:
    """Where the table goes on the platform, y, m: in front of the robot, or as near to that as the legs allow."""
    y = float(scene.objects["platform"].position[1])
    spare = _spare_y(scene)
    return y - min(max(y, -spare), spare)


def _set_down(table: Pose, scene: Scene) -> Pose:
    """The table level on the platform, where it is over it, or as near to that as its legs allow: it may have swung back."""
    x, y, _ = scene.objects["platform"].position
    spare_x, spare_y = _spare_x(scene), _spare_y(scene)
    return Pose(
        (
            min(max(table.position[0], x - spare_x), x + spare_x),
            min(max(table.position[1], y - spare_y), y + spare_y),
            height_of_platform(scene),
        )
    )


def _far(scene: Scene) -> float:
    """0 where the table goes as far as in the nominal scene, or less far, 1 where it goes 4 cm further, or more."""
    return _ramp(goal_x(scene), PLATFORM_X, PLATFORM_X + 0.04)


def _carrying_pitch(scene: Scene) -> float:
    """How far hands that carry the table point down, deg: 45, and less if the way is long: a flat hand reaches further."""
    return PITCH - 12.0 * _far(scene)


def _levelling(primitive: Primitive) -> Primitive:
    """The primitive, at whose end the hands are pitched to carry the table: they turn about their grips while it stands."""
    (segment,) = primitive.segments

    def goal(scene: Scene) -> Hands:
        hands = segment.goal(scene)
        pitch = _carrying_pitch(scene)
        return {side: HandCommand(_levelled(hand.pose, pitch), hand.opening) for side, hand in hands.items()}

    return replace(primitive, segments=(replace(segment, goal=goal),))


def _levelled(hand: Pose, pitch: float) -> Pose:
    steeper = _pitch(hand) - pitch
    return hand @ _turned(-steeper) if abs(steeper) > 0.5 else hand


def _raised(scene: Scene) -> bool:
    return bool(scene.objects["table"].position[2] > height_of_platform(scene) + 0.01)


def _over_platform(scene: Scene, slack: float) -> bool:
    """Whether the middles of the legs are over the platform, or not more than ``slack`` m beside it."""
    x, y, _ = (scene.objects["platform"].inverse() @ scene.objects["table"]).position
    return bool(abs(x) < _spare_x(scene) + 0.005 + slack and abs(y) < _spare_y(scene) + 0.005 + slack)


RAISED = Need("table raised", _raised)
OVER_PLATFORM = Need("table over the platform", lambda scene: _over_platform(scene, 0.012))
# A heavy table hangs back in the hands after a long way; it is brought back as it is set down.
NEAR_PLATFORM = Need("table over the platform or nearly", lambda scene: _over_platform(scene, 0.05))
ON_BENCH = stands_at("table", 0.0)
OFF_BENCH = Need("table off the bench", lambda scene: not ON_BENCH.holds(scene))
ON_PLATFORM = stands_at("table", height_of_platform, tolerance=0.015)


def _keeps(scene: Scene, side: str) -> bool:
    """Whether the table would fall if this hand opened."""
    stands = ON_BENCH.holds(scene) or (ON_PLATFORM.holds(scene) and OVER_PLATFORM.holds(scene))
    return not stands and holds_grip(scene, side, GRIPS[side])


def make_scene(values: Values) -> Task:
    """The task for some values of its factors."""
    length, depth = values.get("size:length", 1.0), values.get("size:depth", 1.0)
    height, yaw = _platform_height(values), math.radians(values.get("yaw", 0.0))
    return Task(
        name="table_lift",
        description="Lift the table with both hands and set it down upright on the platform.",
        bodies=(BENCH, _table(values), _platform(values)),
        placements={
            BENCH.name: BENCH_PLACEMENT,
            "table": Uniform((0.50, -0.30, 0.0), (0.70, 0.30, 0.0), yaw),
            "platform": fixed((PLATFORM_X + values.get("platform:x", 0.0), values.get("platform:y", 0.0), 0.0)),
        },
        observed=("table",),
        also_observed=("platform",),
        attributes=(("table.length", WIDTH * length), ("table.depth", DEPTH * depth), ("platform.height", height)),
        primitives=(
            replace(grasp(GRIPS), keeps=_keeps),
            _levelling(move("table", x=before_platform, y=0.0)).needing(HELD, ON_BENCH, unless=OFF_BENCH),
            lift("table", lambda scene: height_of_platform(scene) + 0.06).needing(HELD),
            extend("table", x=goal_x, y=goal_y, follows=("platform",)).needing(HELD, RAISED),
            carry("place", "table", _set_down, jitter=0.5).needing(HELD, NEAR_PLATFORM),
            retract().needing(ON_PLATFORM, OVER_PLATFORM),
        ),
        recovery=(replace(retract(), keeps=_keeps),),
        success=(
            upright("table"),
            at_height("table", height),
            at_rest("table"),
            touching("table", "platform"),
            not_touching("table", ROBOT),
        ),
        dwell=9,
        stages=(
            Stage("table raised", (raised("table", 0.05),)),
            Stage("table on the platform", (at_height("table", height), touching("table", "platform"))),
        ),
        factors=FACTORS,
        events=EVENTS,
        vary=make_scene,
        admissible=admissible,
    )


TASK = make_scene({})
