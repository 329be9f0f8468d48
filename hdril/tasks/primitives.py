"""Movement primitives: labelled pieces of a demonstration, each a short list of waypoints for both hands.

A primitive is planned from what is observed at its first frame, so that each one starts from where the objects really are.
Where a segment follows an object, the rest of the plan is made anew when that object moves. The functions under
"constructors" make the primitives; a task puts them in order and says what each one needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import Pose, interpolate
from hdril.simulation.actions import HandCommand, join_action
from hdril.simulation.robots.spec import SIDES

Hands = dict[str, HandCommand]


@dataclass(frozen=True)
class Scene:
    """What a primitive is planned from: what the hands were last told, where they are, and where the objects are (world)."""

    hands: Hands
    """What the hands were last told. Plans begin here and not where the hands are: a load pulls a hand away from its target,
    and planning from there would loosen the grip a little with every primitive."""
    objects: dict[str, Pose]
    measured: Hands = field(default_factory=dict)
    """Where the hands are, and how far they are open."""
    attributes: dict[str, float] = field(default_factory=dict)
    """:attr:`hdril.tasks.Task.attributes` of the scene."""


Number = float | Callable[[Scene], float]
"""A number that may depend on the scene."""


def number(value: Number, scene: Scene) -> float:
    """The number in this scene."""
    return value(scene) if callable(value) else value


@dataclass(frozen=True)
class Need:
    """A named test of a scene, as the expert sees it."""

    name: str
    holds: Callable[[Scene], bool]


@dataclass(frozen=True)
class Segment:
    """``frames`` waypoints from the hands of the segment before to ``goal(scene)``.

    ``jitter`` scales the expert's noise. ``rigid`` gives both hands the same noise, because two stiff hands that hold one
    body work against each other if they differ. When one of the objects in ``follows`` moves, the rest is planned anew.

    Raises:
        ValueError: there is not one frame.
    """

    frames: int
    goal: Callable[[Scene], Hands]
    jitter: float = 1.0
    rigid: bool = False
    follows: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ValueError(f"a segment of a primitive must have at least 1 frame, got {self.frames}")


@dataclass(frozen=True)
class Primitive:
    """A label and the segments that make its waypoints.

    The expert plays it only while all ``needs`` hold, and passes over it where ``unless`` holds. Where it begins, ``before`` must
    hold: the same as ``needs`` unless given.
    """

    name: str
    segments: tuple[Segment, ...]
    needs: tuple[Need, ...] = ()
    unless: Need | None = None
    before: tuple[Need, ...] | None = None
    keeps: Callable[[Scene, str], bool] | None = None
    """Whether a hand (scene, side) stays as it was told to be, for the whole primitive, because of what it holds where the
    primitive begins."""

    @property
    def frames(self) -> int:
        return sum(segment.frames for segment in self.segments)

    def needing(self, *needs: Need, unless: Need | None = None, before: tuple[Need, ...] | None = None) -> Primitive:
        """This primitive with these needs."""
        return replace(self, needs=needs, unless=unless, before=before)

    def possible(self, scene: Scene) -> bool:
        """Whether it can begin."""
        return all(need.holds(scene) for need in (self.needs if self.before is None else self.before))

    def superfluous(self, scene: Scene) -> bool:
        """Whether what it is for has been done."""
        return self.unless is not None and self.unless.holds(scene)


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


FOLLOW_DISTANCE, FOLLOW_ANGLE = 0.005, math.radians(2.0)
"""A plan is made anew when an object that it follows is further than this, m and rad, from where it was planned for."""


class Plan:
    """The waypoints (frames, 16) of a primitive, in the order of :data:`hdril.simulation.actions.ACTION_NAMES`.

    Its length does not change, whatever it follows.
    """

    def __init__(self, primitive: Primitive, scene: Scene, noise: Noise, rng: np.random.Generator) -> None:
        self.primitive = primitive
        self._scene = scene
        # Once and for all: a hand that changed its mind would be neither a demonstration of keeping nor one of letting go.
        self._kept = {side: scene.hands[side] for side in SIDES if primitive.keeps and primitive.keeps(scene, side)}
        offsets = [_offsets(segment, noise, rng) for segment in primitive.segments]
        self._offsets = {side: np.concatenate([each[side] for each in offsets]) for side in SIDES}
        self._frame = 0
        self._clean: list[Hands] = []
        self._plan()

    @property
    def over(self) -> bool:
        """Whether there are no more waypoints."""
        return self._frame >= self.primitive.frames

    def next(self) -> NDArray[np.float64]:
        """The next waypoint (16,)."""
        self._frame += 1
        return join_action(self._noisy(self._frame - 1))

    def follow(self, scene: Scene) -> None:
        """Plan the rest anew if an object that is followed has moved."""
        if self.over:
            return
        follows = self._segment_at(self._frame).follows
        moved = {name: scene.objects[name] for name in follows if _moved(self._scene, scene, name)}
        if moved:
            self._scene = replace(self._scene, objects=self._scene.objects | moved)
            self._plan()

    def _segment_at(self, frame: int) -> Segment:
        for segment in self.primitive.segments:
            if frame < segment.frames:
                return segment
            frame -= segment.frames
        raise IndexError("the primitive is over")

    def _plan(self) -> None:
        """Waypoints without noise from the present frame on, from the last one that was told."""
        start = self._clean[self._frame - 1] if self._frame else self._scene.hands
        clean, first = self._clean[: self._frame], self._frame
        for segment in self.primitive.segments:
            if first >= segment.frames:
                first -= segment.frames
                continue
            goal, done = segment.goal(self._scene) | self._kept, _ease(first / segment.frames)
            for i in range(first, segment.frames):
                fraction = (_ease((i + 1) / segment.frames) - done) / (1.0 - done)
                poses = {side: interpolate(start[side].pose, goal[side].pose, fraction) for side in SIDES}
                clean.append({side: HandCommand(poses[side], goal[side].opening) for side in SIDES})
            start, first = goal, 0
        self._clean = clean

    def _noisy(self, frame: int) -> Hands:
        return {
            side: HandCommand(hand.pose.translated(self._offsets[side][frame]), hand.opening)
            for side, hand in self._clean[frame].items()
        }


def _moved(before: Scene, now: Scene, name: str) -> bool:
    a, b = before.objects[name], now.objects[name]
    if math.dist(a.position, b.position) > FOLLOW_DISTANCE:
        return True
    return abs(float(a.quaternion @ b.quaternion)) < math.cos(0.5 * FOLLOW_ANGLE)


# ---------------------------------------------------------------------- goals


@dataclass(frozen=True)
class Grip:
    """Where a hand takes hold: a tool pose in the frame of a body, which may depend on the scene."""

    body: str
    pose: Pose | Callable[[Scene], Pose]

    def tool(self, scene: Scene) -> Pose:
        """The tool pose in the world."""
        return scene.objects[self.body] @ (self.pose(scene) if callable(self.pose) else self.pose)


Grips = dict[str, Grip]
"""A grip for each side."""


def at_grips(grips: Grips, opening: float, back_off: float = 0.0, above: float = 0.0) -> Callable[[Scene], Hands]:
    """Each hand at its grip, backed off along its approach (tool z) and raised (world z) by metres."""

    def goal(scene: Scene) -> Hands:
        retreat = Pose((0.0, 0.0, -back_off))
        return {
            side: HandCommand((grip.tool(scene) @ retreat).translated((0.0, 0.0, above)), opening)
            for side, grip in grips.items()
        }

    return goal


def _bodies(grips: Grips) -> tuple[str, ...]:
    """What the grips are on, each once."""
    return tuple(dict.fromkeys(grip.body for grip in grips.values()))


# ---------------------------------------------------------------------- needs


HINDERED = 0.03
"""A hand that is further than this, m, from where it was told to be has been hindered."""
WIDEST = 0.9
"""A hand that is told to close and stays open further than this (0 to 1) has not closed."""


def holds_grip(scene: Scene, side: str, grip: Grip, tolerance: float = 0.03, thinnest: float = 0.1) -> bool:
    """Whether a hand holds what it grips: it has closed as it was told, within ``tolerance`` m of its grip, and is not empty.

    A hand that closes on nothing is open by less than ``thinnest`` (0 to 1).
    """
    hand = scene.measured[side]
    near = math.dist(hand.pose.position, grip.tool(scene).position) < tolerance
    return bool(scene.hands[side].opening < 0.5 and thinnest < hand.opening < WIDEST and near)


def holding(grips: Grips, tolerance: float = 0.03, thinnest: float = 0.1) -> Need:
    """Each hand holds what it grips: :func:`holds_grip`."""

    def holds(scene: Scene) -> bool:
        return all(holds_grip(scene, side, grip, tolerance, thinnest) for side, grip in grips.items())

    return Need(f"both hands hold {', '.join(_bodies(grips))}", holds)


def stands_at(body: str, height: Number, tolerance: float = 0.03) -> Need:
    """The body's origin is within ``tolerance`` of ``height``, m, and it stands upright."""

    def holds(scene: Scene) -> bool:
        pose, wanted = scene.objects[body], number(height, scene)
        return bool(abs(pose.position[2] - wanted) < tolerance and pose.rotation_matrix()[2, 2] > 0.95)

    return Need(f"{body} stands", holds)


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
            Segment(frames - close - reach, at_grips(grips, 1.0, back_off=clearance), follows=_bodies(grips)),
            Segment(reach, at_grips(grips, 1.0), jitter=0.25, follows=_bodies(grips)),
            Segment(close, at_grips(grips, 0.0), jitter=0.0),
        ),
    )


def reach(name: str, grips: Grips, frames: int = 10, above: float = 0.12) -> Primitive:
    """Bring open hands to ``above`` metres over their grips."""
    return Primitive(name, (Segment(frames, at_grips(grips, 1.0, above=above), follows=_bodies(grips)),))


def lower(name: str, grips: Grips, frames: int = 10) -> Primitive:
    """Come down on the grips with open hands, and close."""
    close = 3
    return Primitive(
        name,
        (
            Segment(frames - close, at_grips(grips, 1.0), jitter=0.25, follows=_bodies(grips)),
            Segment(close, at_grips(grips, 0.0), jitter=0.0),
        ),
    )


def carry(
    name: str,
    body: str,
    target: Callable[[Pose, Scene], Pose],
    frames: int = 12,
    jitter: float = 1.0,
    follows: tuple[str, ...] = (),
) -> Primitive:
    """Take a body that both hands hold to ``target(body pose, scene)``.

    The goal hangs on where body and hands were when the primitive began, so that a plan that is made anew does not drift. It
    follows only what stands elsewhere.
    """
    goal = carry_to(dict.fromkeys(SIDES, body), lambda scene: {body: target(scene.objects[body], scene)})
    return Primitive(name, (Segment(frames, goal, jitter=jitter, rigid=True, follows=follows),))


def carry_each(
    name: str, held: dict[str, str], targets: Targets, frames: int = 12, jitter: float = 1.0, rigid: bool = False
) -> Primitive:
    """Take the body in each hand to its own target. ``rigid`` once the bodies are joined."""
    return Primitive(name, (Segment(frames, carry_to(held, targets), jitter=jitter, rigid=rigid),))


def move(body: str, x: Number, y: Number, frames: int = 12) -> Primitive:
    """Slide a held body over the bench to (x, y), m, squaring it to the world's axes."""

    def target(pose: Pose, scene: Scene) -> Pose:
        return Pose((number(x, scene), number(y, scene), pose.position[2]))

    return carry("move", body, target, frames, jitter=0.5)


def lift(body: str, height: Number, frames: int = 12) -> Primitive:
    """Raise a held body to ``height``, m, level."""
    return carry("lift", body, _at_height(height), frames)


def extend(body: str, x: Number, y: Number, frames: int = 12, follows: tuple[str, ...] = ()) -> Primitive:
    """Bring a lifted body forward to (x, y), m, level."""

    def target(pose: Pose, scene: Scene) -> Pose:
        return Pose((number(x, scene), number(y, scene), pose.position[2]))

    return carry("extend", body, target, frames, follows=follows)


def place(body: str, height: Number, frames: int = 12) -> Primitive:
    """Set a held body down on a surface at ``height``, m."""
    return carry("place", body, _at_height(height), frames, jitter=0.5)


def _at_height(height: Number) -> Callable[[Pose, Scene], Pose]:
    """A body where it is, level, at a height."""

    def target(pose: Pose, scene: Scene) -> Pose:
        return Pose((pose.position[0], pose.position[1], number(height, scene)))

    return target


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
