"""Two half tables are brought together: where hands take hold, what each primitive needs, and the primitives in order."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose, geodesic_distance, interpolate
from hdril.simulation.actions import HandCommand
from hdril.simulation.robots.spec import SIDES
from hdril.tasks.half_tables import (
    GRIP_HEIGHT,
    HALVES,
    HANDLE_Y,
    LEFT,
    PEG_LENGTH,
    RIGHT,
    SIGN,
    WIDTH,
    depth_of_peg,
    gap_between,
)
from hdril.tasks.primitives import (
    HINDERED,
    Grip,
    Grips,
    Hands,
    Need,
    Primitive,
    Scene,
    Segment,
    Targets,
    at_grips,
    carry_each,
    carry_to,
    holding,
    lift_joined,
    lower,
    reach,
)

APART = 0.0575  # of an aligned half's face from y = 0: the tip of the peg is 1.5 cm before the hole
ABOVE = 0.12
"""How high hands travel over the grips, m."""


# ---------------------------------------------------------------------- grips


def _pitched(degrees: float) -> Rotation:
    """A hand that points down by ``degrees`` and forward, its jaws across a handle."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return Rotation.from_matrix(np.array([[-s, 0.0, c], [0.0, 1.0, 0.0], [-c, 0.0, -s]]))


def _turned(x: float, y: float, heading: float) -> tuple[float, float]:
    """How a hand takes a handle at (x, y), m, whose body is turned by ``heading``: its pitch and its own turn, degrees.

    For the right hand: y > 0 is across the robot's middle. It points down by 60 degrees on its own side; across the middle, more
    steeply near the robot and less steeply far from it. Where it reaches no further it turns by up to 15 degrees to where it
    goes: the jaws then stand askew. The limits are straight lines fitted to Baxter's inverse kinematics, less 2 cm.
    """
    outside = float(np.clip((-0.2 - y) / 0.2, 0.0, 1.0))
    inner = np.clip(60.0 - 150.0 * (x - 0.60), 45.0, 75.0)
    across = min(0.37 - 0.4 * (x - 0.45), 0.25 - 0.95 * (x - 0.70)) + min(0.0027 * heading, 0.004 * heading)
    out = -0.86 + 0.7 * max(x - 0.50, 0.0) + 0.005 * heading
    turn = np.clip((y - across) / 0.003, 0.0, 15.0) - np.clip((out - y) / 0.003, 0.0, 15.0)
    return float((1.0 - outside) * inner + outside * 60.0), float(turn)


def grip_on(half: str, side: str, y: float) -> Grip:
    """A hand on the half's left (``y`` = 1) or right (-1) handle, turned to where it reaches it: :func:`_turned`."""
    mirror = 1.0 if side == "right" else -1.0

    def pose(scene: Scene) -> Pose:
        body, handle = scene.objects[half], Pose((0.0, y * HANDLE_Y * _length(scene, half) / WIDTH, GRIP_HEIGHT))
        at = (body @ handle).position
        pitch, turn = _turned(at[0], mirror * at[1], mirror * math.degrees(body.heading))
        return Pose(
            handle.position, (Rotation.from_euler("z", mirror * turn, degrees=True) * _pitched(pitch)).as_quat()
        )

    return Grip(half, pose)


def grips_on(left: str, right: str) -> Grips:
    """Hands on the left and right handles of one half, or on the outer handles of both."""
    return {side: grip_on(half, side, y) for side, half, y in zip(SIDES, (left, right), (1.0, -1.0), strict=True)}


ON_LEFT, ON_RIGHT, ON_BOTH = grips_on(LEFT, LEFT), grips_on(RIGHT, RIGHT), grips_on(LEFT, RIGHT)
ON = {LEFT: ON_LEFT, RIGHT: ON_RIGHT}
HELD: dict[str, str] = dict(zip(SIDES, HALVES, strict=True))


# ---------------------------------------------------------------------- needs


def _length(scene: Scene, half: str) -> float:
    return scene.attributes[f"{half}.length"]


def widths_of(scene: Scene) -> tuple[float, float]:
    return _length(scene, LEFT), _length(scene, RIGHT)


def _aligned_y(scene: Scene, half: str) -> float:
    """Where the middle of a half stands, y, m, before the two are joined."""
    return SIGN[half] * (_length(scene, half) / 2 + APART)


def _stands_aligned(scene: Scene, half: str, distance: float, degrees: float) -> bool:
    pose = scene.objects[half]
    near = abs(pose.position[1] - _aligned_y(scene, half)) < distance
    return bool(near and abs(pose.heading) < math.radians(degrees) and abs(pose.position[2]) < 0.02)


def _face_each_other(scene: Scene, distance: float, degrees: float) -> bool:
    """Whether the halves stand opposite each other, up to a distance along x and an angle, ready to be joined or joined."""
    left, right = scene.objects[LEFT], scene.objects[RIGHT]
    x, _, z = (left.inverse() @ right).position
    turn = math.degrees(right.heading - left.heading)
    near = -0.01 < gap_between(left, right, widths_of(scene)) < 2 * APART + 0.03
    return bool(near and abs(x) < distance and abs(turn) < degrees and abs(z) < 0.02)


def _done(half: str) -> Need:
    """The half needs no moving: it stands where it shall, or both can be joined as they stand."""

    def holds(scene: Scene) -> bool:
        placed = _stands_aligned(scene, half, 0.012, 3.0)
        opposite = half == LEFT or abs(scene.objects[LEFT].position[0] - scene.objects[RIGHT].position[0]) < 0.012
        return (placed and opposite) or _face_each_other(scene, 0.012, 3.0)

    return Need(f"{half} stands ready", holds)


LEFT_READY = Need(
    "left_half stands about ready",
    lambda scene: _stands_aligned(scene, LEFT, 0.03, 6.0) or _face_each_other(scene, 0.03, 6.0),
)
BOTH_READY = Need("halves face each other", lambda scene: _face_each_other(scene, 0.03, 6.0))
OPPOSITE = Need("halves opposite each other", lambda scene: _face_each_other(scene, 0.02, 5.0))
CLOSED = Need(
    "gap closed", lambda scene: gap_between(scene.objects[LEFT], scene.objects[RIGHT], widths_of(scene)) < 0.01
)
INSERTED = Need(
    "peg in the hole",
    lambda scene: depth_of_peg(scene.objects[LEFT], scene.objects[RIGHT], widths_of(scene)) > 0.02,
)
HIGH = Need(
    "hands high and open",
    lambda scene: all(
        hand.pose.position[2] > GRIP_HEIGHT + 0.05 and hand.opening > 0.8 for hand in scene.measured.values()
    ),
)
OVER_ALL = Need(
    "hands over all handles",
    lambda scene: all(hand.pose.position[2] > GRIP_HEIGHT + 0.04 for hand in scene.measured.values()),
)
STRAIGHT = Need(
    "hands rise straight",  # an arm with a stopped motor swings aside, and its open hand takes the half along
    lambda scene: all(
        hand.pose.position[2] > GRIP_HEIGHT + 0.05
        or math.dist(hand.pose.position[:2], scene.hands[side].pose.position[:2]) < HINDERED
        for side, hand in scene.measured.items()
    ),
)


def _over(grips: Grips) -> Need:
    """Each hand is in a cone over its grip or at it: a hand that comes from far is 11 cm late when the motion ends.

    One that is higher was stopped, and would come down beside its handle.
    """

    def holds(scene: Scene) -> bool:
        offsets = [scene.measured[side].pose.position - grip.tool(scene).position for side, grip in grips.items()]
        return all(math.hypot(x, y) < 0.05 + 1.5 * max(z, 0.0) and -0.03 < z < ABOVE + 0.06 for x, y, z in offsets)

    return Need("hands over the handles", holds)


def _firm(grips: Grips) -> Need:
    """Each hand is where it was told to be, and stands to its handle as it was put there.

    A hand that is not has slipped or pulls in vain: it must let go and take hold again, because the targets that follow from
    its last command would only move further away.
    """

    def holds(scene: Scene) -> bool:
        for side, grip in grips.items():
            told, hand, tool = scene.hands[side].pose, scene.measured[side].pose, grip.tool(scene)
            if math.dist(told.position, hand.position) > 0.02:
                return False
            if geodesic_distance(hand.quaternion, tool.quaternion) > math.radians(6.0):
                return False
        return True

    return Need("grips firm", holds)


# ---------------------------------------------------------------------- script


def squared_at(y: Callable[[Scene, str], float], *bodies: str) -> Targets:
    """``bodies`` square to the world at x in the middle between the halves, at y = ``y(scene, body)``."""

    def targets(scene: Scene) -> dict[str, Pose]:
        x = 0.5 * (scene.objects[LEFT].position[0] + scene.objects[RIGHT].position[0])
        return {body: Pose((x, y(scene, body), scene.objects[body].position[2])) for body in bodies}

    return targets


def _near_y(scene: Scene, half: str) -> float:
    """The tip of the peg is 4 mm before the hole: what it errs on a longer way, it errs at the hole."""
    return SIGN[half] * (0.5 * (_length(scene, half) + PEG_LENGTH + 0.004))


def _pressed_y(scene: Scene, half: str) -> float:
    """4 mm further than a half can go: the hands press the faces together."""
    return SIGN[half] * (_length(scene, half) / 2 - 0.004)


def _opposite(scene: Scene) -> dict[str, Pose]:
    """The right half square to the world, opposite the left one."""
    x, z = scene.objects[LEFT].position[0], scene.objects[RIGHT].position[2]
    return {RIGHT: Pose((x, _aligned_y(scene, RIGHT), z))}


def _opened(height: float | None = None) -> Callable[[Scene], Hands]:
    """Open hands where they were told to be, or where they are if they were hindered; at ``height``, m, if it is given."""

    def goal(scene: Scene) -> Hands:
        hands = {}
        for side, told in scene.hands.items():
            pose, measured = told.pose, scene.measured[side].pose
            pose = pose if math.dist(pose.position, measured.position) < HINDERED else measured
            z = pose.position[2] if height is None else height
            hands[side] = HandCommand(Pose((*pose.position[:2], z), pose.quaternion), 1.0)
        return hands

    return goal


def _reach_from_rest(name: str, grips: Grips, frames: int) -> Primitive:
    """As :func:`reach`, but hands that begin low rise first: on the straight way they would drag a half along."""
    over, rise = at_grips(grips, 1.0, above=ABOVE), 3

    def part_way(scene: Scene) -> Hands:
        goals, hands = over(scene), scene.hands
        # The lower a hand is, the more steeply it rises.
        parts = {side: 0.2 * float(np.clip((hands[side].pose.position[2] - 0.38) / 0.05, 0.0, 1.0)) for side in SIDES}
        poses = {side: interpolate(hands[side].pose, goal.pose, parts[side]) for side, goal in goals.items()}
        return {
            side: HandCommand(Pose((*pose.position[:2], goals[side].pose.position[2]), pose.quaternion), 1.0)
            for side, pose in poses.items()
        }

    bodies = tuple(dict.fromkeys(grip.body for grip in grips.values()))
    return Primitive(name, (Segment(rise, part_way, follows=bodies), Segment(frames - rise, over, follows=bodies)))


def _connect(frames: int) -> Primitive:
    """Square the halves opposite each other where they are, then press them together.

    Without the first part, the peg enters the hole before the errors that the alignment left are made good. Without noise: a
    half that is pushed by one hand turns, and 3 mm beside the hole's axis the peg jams.
    """
    square = carry_to(HELD, squared_at(lambda scene, half: float(scene.objects[half].position[1]), *HALVES))
    press = carry_to(HELD, squared_at(_pressed_y, *HALVES))
    return Primitive("connect", (Segment(3, square, jitter=0.0), Segment(frames - 3, press, jitter=0.0)))


def _release(name: str, frames: int) -> Primitive:
    """Open the hands and raise them. It can be begun at any time; what it needs is looked at while it goes on."""
    rise = Segment(frames - 2, _opened(GRIP_HEIGHT + ABOVE), jitter=0.25)
    return Primitive(name, (Segment(2, _opened(), jitter=0.0), rise)).needing(STRAIGHT, unless=HIGH, before=())


def _from_above(primitive: Primitive, *needs: Need, unless: Need | None = None) -> Primitive:
    """A primitive that begins with both hands over all handles: from beside a half they would knock it over."""
    return primitive.needing(*needs, unless=unless, before=(OVER_ALL, *needs))


def _phase(half: str, targets: Targets, frames: int, *needs: Need) -> tuple[Primitive, ...]:
    """Take a half with both hands to where it shall stand, and leave it there. To reach and to grasp it needs ``needs``."""
    name, done, grips = half.removesuffix("_half"), _done(half), ON[half]
    first = (reach if needs else _reach_from_rest)(f"reach_{name}", grips, frames)
    move = carry_each(f"move_{name}", dict.fromkeys(SIDES, half), targets, frames, 0.5, rigid=True)
    return (
        _from_above(first, *needs, unless=done) if needs else first.needing(unless=done),
        _from_above(lower(f"grasp_{name}", grips, frames), _over(grips), *needs, unless=done),
        move.needing(holding(grips), unless=done),
        _release(f"retract_{name}", frames),
    )


def _primitives(frames: int = 10) -> tuple[Primitive, ...]:
    held, firm = holding(ON_BOTH), _firm(ON_BOTH)
    return (
        *_phase(LEFT, squared_at(_aligned_y, LEFT), frames),
        *_phase(RIGHT, _opposite, frames, LEFT_READY),
        _from_above(reach("reach_both", ON_BOTH, frames), BOTH_READY),
        _from_above(lower("grasp_both", ON_BOTH, frames), _over(ON_BOTH), BOTH_READY),
        carry_each("align", HELD, squared_at(_near_y, *HALVES), frames, jitter=0.1).needing(
            held, firm, unless=INSERTED
        ),
        _connect(frames).needing(held, firm, OPPOSITE),
        lift_joined("lift", rise=0.12, frames=frames).needing(held, CLOSED),
    )


RELEASE = _release("retract_left", 10)
"""Before the left half is fetched anew: :attr:`hdril.tasks.Task.recovery`."""
PRIMITIVES = _primitives()
