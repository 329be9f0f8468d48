"""Primitives without a simulator: what the hands are told, given where they and the objects are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hdril.geometry import Pose, about_z, geodesic_distance, interpolate
from hdril.simulation.actions import HandCommand, hand_poses, openings, split_action
from hdril.simulation.robots import SIDES
from hdril.tasks import primitives
from hdril.tasks.primitives import (
    Grip,
    Hands,
    Noise,
    Plan,
    Primitive,
    Scene,
    Segment,
    at_grips,
    carry,
    carry_each,
    carry_to,
    extend,
    grasp,
    hands_at,
    lift,
    lift_joined,
    lower,
    move,
    place,
    reach,
    retract,
)
from tests.tasks.waypoints import waypoints as planned

QUIET = Noise(0.0)
DOWN = (0.0, 1.0, 0.0, 0.0)  # tool z points down
YAWED = (0.0, 0.0, np.sin(0.2), np.cos(0.2))
SCENE = Scene(
    {
        "left": HandCommand(Pose((0.5, 0.3, 0.4), DOWN), 1.0),
        "right": HandCommand(Pose((0.6, -0.3, 0.5), (0.5, 0.5, -0.5, 0.5)), 0.0),
    },
    {"table": Pose((0.6, 0.1, 0.02), YAWED), "cup": Pose((0.4, -0.2, 0.0))},
)
GRIPS = {"left": Grip("table", Pose((0.0, 0.4, 0.3), DOWN)), "right": Grip("cup", Pose((0.0, -0.1, 0.2), DOWN))}


def same(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.position, b.position, atol=1e-9)
    assert geodesic_distance(a.quaternion, b.quaternion) < 1e-7


def waypoints(primitive: Primitive, scene: Scene = SCENE, noise: Noise = QUIET, seed: int = 0) -> np.ndarray:
    return planned(primitive, scene, noise, seed)


def after(primitive: Primitive, scene: Scene = SCENE) -> Hands:
    """What the hands were told last."""
    return split_action(waypoints(primitive, scene)[-1])


# ---------------------------------------------------------------------- planning


@pytest.mark.parametrize(("fraction", "eased"), [(0.0, 0.0), (0.25, 0.15625), (0.5, 0.5), (0.75, 0.84375), (1.0, 1.0)])
def test_ease(fraction: float, eased: float) -> None:
    assert primitives._ease(fraction) == pytest.approx(eased)


def test_ease_starts_and_ends_at_rest_and_peaks_at_one_and_a_half() -> None:
    rate = np.diff([primitives._ease(s) for s in np.linspace(0.0, 1.0, 1001)]) * 1000
    assert rate.min() > 0.0
    assert rate[[0, -1]] == pytest.approx([0.0, 0.0], abs=0.01)
    assert rate.max() == pytest.approx(1.5, abs=1e-3)


def shifted(offset: tuple[float, float, float], opening: float = 0.5):
    """A goal that moves both hands from where the episode's scene has them."""

    def goal(scene: Scene) -> Hands:
        return {side: HandCommand(hand.pose.translated(offset), opening) for side, hand in scene.hands.items()}

    return goal


def test_a_segment_runs_from_the_hands_to_its_goal() -> None:
    frames, offset = 5, np.array((0.1, -0.2, 0.3))
    planned = waypoints(Primitive("go", (Segment(frames, shifted((0.1, -0.2, 0.3))),)))
    assert planned.shape == (frames, 16)
    poses = hand_poses(planned)
    for i in range(frames):
        for side, hand in enumerate(SCENE.hands.values()):
            eased = primitives._ease((i + 1) / frames)
            np.testing.assert_allclose(poses[i, side, :3], hand.pose.position + eased * offset, atol=1e-12)
    np.testing.assert_array_equal(openings(planned), 0.5)


def test_a_segment_starts_where_the_one_before_ended() -> None:
    """Both goals are measured from the scene at the primitive's first frame."""
    two = Primitive("go", (Segment(3, shifted((0.1, 0.0, 0.0), 1.0)), Segment(4, shifted((0.0, 0.2, 0.0), 0.0))))
    planned = waypoints(two)
    assert two.frames == len(planned) == 7
    first, home = SCENE.hands["left"].pose.translated((0.1, 0.0, 0.0)), SCENE.hands["left"].pose
    np.testing.assert_allclose(hand_poses(planned)[2, 0, :3], first.position, atol=1e-12)
    for i in range(4):
        expected = interpolate(first, home.translated((0.0, 0.2, 0.0)), primitives._ease((i + 1) / 4))
        np.testing.assert_allclose(hand_poses(planned)[3 + i, 0, :3], expected.position, atol=1e-12)
    np.testing.assert_array_equal(openings(planned)[:, 0], [1.0] * 3 + [0.0] * 4)


def test_hands_turn_along_the_great_circle() -> None:
    turned = Pose(SCENE.hands["left"].pose.position, (1.0, 0.0, 0.0, 0.0))
    goal = Segment(4, lambda scene: scene.hands | {"left": HandCommand(turned, 1.0)})
    planned = waypoints(Primitive("turn", (goal,)))
    whole = geodesic_distance(turned.quaternion, DOWN)
    for i, pose in enumerate(hand_poses(planned)[:, 0]):
        assert geodesic_distance(pose[3:], DOWN) == pytest.approx(primitives._ease((i + 1) / 4) * whole)


@pytest.mark.parametrize(
    "make", [lambda: Segment(0, shifted((0.0,) * 3)), lambda: grasp(GRIPS, 5), lambda: lift("cup", 1, -1)]
)
def test_a_primitive_that_is_too_short_is_refused(make) -> None:
    with pytest.raises(ValueError, match=r"^a segment of a primitive must have at least 1 frame, got (0|-1)$"):
        make()


# ---------------------------------------------------------------------- noise


def noise_of(segment: Segment, noise: Noise, seed: int) -> np.ndarray:
    """Offsets (frames, 2, 3) from the waypoints without noise."""
    primitive = Primitive("go", (segment,))
    return (hand_poses(waypoints(primitive, noise=noise, seed=seed)) - hand_poses(waypoints(primitive)))[..., :3]


def test_offsets_are_smooth_and_vanish_at_the_end() -> None:
    """offset = waypoint * jitter * sin(pi s) (a + b cos(pi s)), s from 1 / frames to 1, with a and b standard normal."""
    frames, noise = 9, Noise(0.01)
    fractions = np.arange(1, frames + 1) / frames
    for seed in range(3):
        offsets = noise_of(Segment(frames, shifted((0.0,) * 3), jitter=0.5), noise, seed)
        assert np.abs(offsets[-1]).max() < 1e-12
        rng = np.random.default_rng(seed)
        for side in range(2):
            a, b = rng.normal(size=(2, 3))
            wave = np.sin(np.pi * fractions)[:, None] * (a + np.cos(np.pi * fractions)[:, None] * b)
            np.testing.assert_allclose(offsets[:, side], 0.01 * 0.5 * wave, atol=1e-12)


def test_offsets_have_the_standard_deviation_that_was_asked_for() -> None:
    segment = Segment(2, shifted((0.0,) * 3))
    middle = np.concatenate([noise_of(segment, Noise(0.004), seed)[0].ravel() for seed in range(100)])
    assert middle.std() == pytest.approx(0.004, rel=0.1)
    assert abs(middle.mean()) < 0.0005


def test_hands_that_hold_one_body_get_the_same_offset() -> None:
    free, rigid = (noise_of(Segment(6, shifted((0.0,) * 3), rigid=rigid), Noise(), 1) for rigid in (False, True))
    np.testing.assert_allclose(rigid[:, 0], rigid[:, 1], atol=1e-12)
    assert np.abs(free[:, 0] - free[:, 1]).max() > 1e-3
    np.testing.assert_allclose(rigid[:, 0], free[:, 0], atol=1e-12)


def test_no_jitter_is_no_noise() -> None:
    assert np.abs(noise_of(Segment(6, shifted((0.0,) * 3), jitter=0.0), Noise(0.02), 0)).max() < 1e-12


def test_noise_draws_numbers_whatever_its_size() -> None:
    """A later primitive gets the same random numbers whether or not an earlier one was noisy."""
    states = []
    for noise in (QUIET, Noise(0.01)):
        rng = np.random.default_rng(4)
        Plan(lift("table", 0.2), SCENE, noise, rng)
        states.append(rng.bit_generator.state)
    assert states[0] == states[1]


@pytest.mark.parametrize("waypoint", [-1e-6, 0.020001, np.nan])
def test_noise_out_of_range_is_refused(waypoint: float) -> None:
    with pytest.raises(ValueError, match=rf"^noise\.waypoint must be from 0 to 0\.02 m, got {waypoint}$"):
        Noise(waypoint)


def test_noise_at_the_ends_of_its_range() -> None:
    assert (Noise(0.0).waypoint, Noise(0.02).waypoint, Noise().waypoint) == (0.0, 0.02, 0.004)


# ---------------------------------------------------------------------- goals


def test_at_grips_is_at_the_grips() -> None:
    hands = at_grips(GRIPS, 0.3)(SCENE)
    for side, grip in GRIPS.items():
        same(hands[side].pose, SCENE.objects[grip.body] @ grip.pose)
        assert hands[side].opening == 0.3


def test_at_grips_backs_off_along_the_tool_and_rises_along_the_world() -> None:
    tilted = {side: Grip("table", Pose((0.0, 0.1, 0.3), (0.0, 1.0, 0.0, 0.6))) for side in SIDES}
    plain = at_grips(tilted, 1.0)(SCENE)
    moved = at_grips(tilted, 1.0, back_off=0.05, above=0.2)(SCENE)
    for side in SIDES:
        approach = plain[side].pose.rotation_matrix()[:, 2]
        expected = plain[side].pose.position - 0.05 * approach + (0.0, 0.0, 0.2)
        same(moved[side].pose, Pose(expected, plain[side].pose.quaternion))


def test_carry_to_keeps_each_hand_where_it_holds() -> None:
    held = {"left": "table", "right": "cup"}
    goals = {"table": Pose((0.7, 0.0, 0.2)), "cup": Pose((0.3, 0.1, 0.4), YAWED)}
    hands = carry_to(held, lambda scene: goals)(SCENE)
    for side, body in held.items():
        grip = SCENE.objects[body].inverse() @ SCENE.hands[side].pose
        same(hands[side].pose, goals[body] @ grip)
        assert hands[side].opening == SCENE.hands[side].opening


def test_hands_at_backs_off_rises_and_opens() -> None:
    hands = hands_at(0.7, back_off=0.1, rise=0.02)(SCENE)
    for side, hand in SCENE.hands.items():
        expected = hand.pose.position - 0.1 * hand.pose.rotation_matrix()[:, 2] + (0.0, 0.0, 0.02)
        same(hands[side].pose, Pose(expected, hand.pose.quaternion))
        assert hands[side].opening == 0.7
    for side, hand in hands_at(0.0)(SCENE).items():
        same(hand.pose, SCENE.hands[side].pose)


# ---------------------------------------------------------------------- the vocabulary


def test_grasp_approaches_open_reaches_in_and_closes() -> None:
    for frames in (8, 10, 15):
        primitive = grasp(GRIPS, frames, clearance=0.06)
        planned = waypoints(primitive)
        assert primitive.name == "grasp"
        assert primitive.frames == len(planned) == frames
        assert [segment.frames for segment in primitive.segments] == [frames - 5, 3, 2]
        assert [segment.jitter for segment in primitive.segments] == [1.0, 0.25, 0.0]
        np.testing.assert_array_equal(openings(planned), [[1.0, 1.0]] * (frames - 2) + [[0.0, 0.0]] * 2)
        before, at = at_grips(GRIPS, 1.0, back_off=0.06)(SCENE), at_grips(GRIPS, 1.0)(SCENE)
        for side in SIDES:
            same(split_action(planned[frames - 6])[side].pose, before[side].pose)
            same(split_action(planned[frames - 3])[side].pose, at[side].pose)
            same(split_action(planned[-1])[side].pose, at[side].pose)
    default = hand_poses(waypoints(grasp(GRIPS)))
    assert len(default) == 10
    assert np.linalg.norm(default[4, :, :3] - default[-1, :, :3], axis=-1) == pytest.approx([0.08, 0.08])


def test_reach_ends_above_the_grips_with_open_hands() -> None:
    primitive = reach("reach_left", GRIPS, 7, above=0.2)
    assert (primitive.name, primitive.frames) == ("reach_left", 7)
    for side, hand in after(primitive).items():
        same(hand.pose, at_grips(GRIPS, 1.0, above=0.2)(SCENE)[side].pose)
        assert hand.opening == 1.0
    raised = after(reach("reach", GRIPS))["left"].pose.position - at_grips(GRIPS, 1.0)(SCENE)["left"].pose.position
    assert raised == pytest.approx([0.0, 0.0, 0.12])
    assert reach("reach", GRIPS).frames == 10


def test_lower_comes_down_open_and_closes() -> None:
    for frames in (6, 10):
        primitive = lower("grasp_left", GRIPS, frames)
        planned = waypoints(primitive)
        assert (primitive.name, primitive.frames, len(planned)) == ("grasp_left", frames, frames)
        assert [(s.frames, s.jitter) for s in primitive.segments] == [(frames - 3, 0.25), (3, 0.0)]
        np.testing.assert_array_equal(openings(planned), [[1.0, 1.0]] * (frames - 3) + [[0.0, 0.0]] * 3)
        for side in SIDES:
            for row in (frames - 4, frames - 1):
                same(split_action(planned[row])[side].pose, at_grips(GRIPS, 0.0)(SCENE)[side].pose)
    assert lower("grasp", GRIPS).frames == 10


def body_after(primitive: Primitive, body: str = "table") -> dict[str, Pose]:
    """Where the body is after the primitive, as each hand that holds it says."""
    hands = after(primitive)
    return {
        side: hands[side].pose @ (SCENE.hands[side].pose.inverse() @ SCENE.objects[body]) for side in SCENE.hands
    }  # fmt: skip


TABLE = SCENE.objects["table"].position


@pytest.mark.parametrize(
    ("make", "goal", "name", "jitter"),
    [
        (lambda: move("table", x=0.7, y=-0.1, frames=5), Pose((0.7, -0.1, TABLE[2])), "move", 0.5),
        (lambda: lift("table", height=0.3, frames=6), Pose((TABLE[0], TABLE[1], 0.3)), "lift", 1.0),
        (lambda: extend("table", x=0.9, y=0.05, frames=7), Pose((0.9, 0.05, TABLE[2])), "extend", 1.0),
        (lambda: place("table", height=0.1, frames=8), Pose((TABLE[0], TABLE[1], 0.1)), "place", 0.5),
        (lambda: carry("spin", "table", lambda pose, scene: pose @ Pose((0, 0, 0), YAWED), 9, jitter=0.7),
         SCENE.objects["table"] @ Pose((0, 0, 0), YAWED), "spin", 0.7),
    ],
)  # fmt: skip
def test_a_carried_body_goes_to_its_target(make: Callable[[], Primitive], goal: Pose, name: str, jitter: float) -> None:
    primitive = make()
    assert primitive.name == name
    assert len(waypoints(primitive)) == primitive.frames
    (segment,) = primitive.segments
    assert (segment.jitter, segment.rigid) == (jitter, True)
    for where in body_after(primitive).values():
        same(where, goal)
    for side, hand in after(primitive).items():
        assert hand.opening == SCENE.hands[side].opening


def test_frames_of_carried_bodies() -> None:
    given = [move("table", 0.6, 0.0, 5), lift("table", 0.2, 6), extend("table", 0.9, 0.0, 7), place("table", 0.1, 8)]
    assert [primitive.frames for primitive in given] == [5, 6, 7, 8]
    usual = [move("table", 0.6, 0.0), lift("table", 0.2), extend("table", 0.9, 0.0), place("table", 0.1)]
    assert {primitive.frames for primitive in usual} == {12}


def test_carry_each_takes_each_body_to_its_own_target() -> None:
    held = {"left": "cup", "right": "table"}
    goals = {"table": Pose((0.7, 0.0, 0.2)), "cup": Pose((0.3, 0.1, 0.4))}
    primitive = carry_each("connect", held, lambda scene: goals, 4, jitter=0.1, rigid=True)
    assert (primitive.name, primitive.frames) == ("connect", 4)
    assert [(s.jitter, s.rigid) for s in primitive.segments] == [(0.1, True)]
    for side, body in held.items():
        same(body_after(primitive, body)[side], goals[body])
    usual = carry_each("connect", held, lambda scene: goals)
    assert [(s.frames, s.jitter, s.rigid) for s in usual.segments] == [(12, 1.0, False)]
    assert [(s.frames, s.jitter, s.rigid) for s in carry("x", "cup", lambda pose, scene: pose).segments] == [
        (12, 1.0, True)
    ]


def test_lift_joined_raises_both_hands_and_presses_them_together() -> None:
    primitive = lift_joined("raise", rise=0.2, squeeze=0.01, frames=4)
    assert (primitive.name, primitive.frames) == ("raise", 4)
    assert primitive.segments[0].rigid
    hands = after(primitive)
    before = {side: hand.pose.position for side, hand in SCENE.hands.items()}
    line = (before["right"] - before["left"]) / np.linalg.norm(before["right"] - before["left"])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        same(hands[side].pose, SCENE.hands[side].pose.translated(sign * 0.01 * line + (0.0, 0.0, 0.2)))
        assert hands[side].opening == SCENE.hands[side].opening
    distance = np.linalg.norm(before["right"] - before["left"])
    assert np.linalg.norm(hands["right"].pose.position - hands["left"].pose.position) == pytest.approx(distance - 0.02)
    usual = lift_joined()
    assert (usual.name, usual.frames) == ("lift", 10)
    rise = sum(after(usual)[side].pose.position[2] - before[side][2] for side in SIDES) / 2
    assert rise == pytest.approx(0.12)
    closer = distance - np.linalg.norm(after(usual)["right"].pose.position - after(usual)["left"].pose.position)
    assert closer == pytest.approx(0.012)


@pytest.mark.parametrize(("frames", "back"), [(12, 5), (11, 4), (9, 3)])
def test_retract_opens_backs_out_and_rises(frames: int, back: int) -> None:
    primitive = retract("leave", frames, distance=0.15, rise=0.08)
    assert (primitive.name, primitive.frames) == ("leave", frames)
    assert [(s.frames, s.jitter) for s in primitive.segments] == [(2, 0.0), (back, 0.25), (frames - 2 - back, 1.0)]
    planned = waypoints(primitive)
    np.testing.assert_array_equal(openings(planned), 1.0)
    for row, goal in (
        (1, hands_at(1.0)),
        (1 + back, hands_at(1.0, back_off=0.15)),
        (-1, hands_at(1.0, back_off=0.15, rise=0.08)),
    ):
        for side in SIDES:
            same(split_action(planned[row])[side].pose, goal(SCENE)[side].pose)


def test_retract_without_a_distance_goes_straight_up() -> None:
    primitive = retract(frames=8, distance=0.0, rise=0.2)
    assert [(s.frames, s.jitter) for s in primitive.segments] == [(2, 0.0), (6, 0.25)]
    planned = hand_poses(waypoints(primitive))
    start = np.stack([hand.pose.position for hand in SCENE.hands.values()])
    np.testing.assert_allclose(planned[:2, :, :3], np.broadcast_to(start, (2, 2, 3)), atol=1e-12)
    np.testing.assert_allclose(planned[-1, :, :3] - start, [[0.0, 0.0, 0.2]] * 2, atol=1e-12)


def test_retract_as_it_is_by_default() -> None:
    primitive = retract()
    assert (primitive.name, primitive.frames) == ("retract", 12)
    for side, hand in after(primitive).items():
        same(hand.pose, hands_at(1.0, back_off=0.1, rise=0.1)(SCENE)[side].pose)


# ---------------------------------------------------------------------- primitives of other lengths


@pytest.mark.parametrize("frames", [6, 7, 10, 23])
def test_a_primitive_of_any_length_ends_at_the_same_hands(frames: int) -> None:
    held = dict.fromkeys(SIDES, "table")
    makers = [
        lambda n: grasp(GRIPS, n),
        lambda n: reach("reach", GRIPS, n),
        lambda n: lower("lower", GRIPS, n),
        lambda n: move("table", 0.6, 0.0, n),
        lambda n: lift("table", 0.3, n),
        lambda n: extend("table", 0.9, 0.0, n),
        lambda n: place("table", 0.1, n),
        lambda n: carry_each("carry", held, lambda scene: {"table": Pose((0.5, 0.0, 0.3))}, n),
        lambda n: lift_joined(frames=n),
        lambda n: retract(frames=n),
        lambda n: retract(frames=n, distance=0.0),
    ]
    for make in makers:
        primitive = make(frames)
        noisy = waypoints(primitive, noise=Noise(), seed=frames)
        assert primitive.frames == len(noisy) == frames
        np.testing.assert_allclose(noisy[-1], waypoints(make(12))[-1], atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("degrees", "again"), [(1.9, False), (-1.9, False), (2.1, True), (-2.1, True), (90.0, True)])
def test_a_plan_follows_an_object_that_turns(degrees: float, again: bool, sign: float) -> None:
    body = next(iter(SCENE.objects))
    pose = SCENE.objects[body]
    grips = dict.fromkeys(SIDES, Grip(body, Pose((0.1, 0.0, 0.0))))
    plan = Plan(reach("reach", grips), SCENE, QUIET, np.random.default_rng(0))
    turned = pose @ Pose((0.0, 0.0, 0.0), about_z(np.deg2rad(degrees)))
    turned = Pose(turned.position, sign * turned.quaternion)
    plan.follow(replace(SCENE, objects=SCENE.objects | {body: turned}))
    rows = np.stack([plan.next() for _ in range(plan.primitive.frames)])
    assert again != np.array_equal(rows, waypoints(plan.primitive))


@pytest.mark.parametrize("kept", [True, False])
def test_a_hand_that_is_kept_stays_so_whatever_moves(kept: bool) -> None:
    """Whether a hand keeps hold is decided where a primitive begins: no demonstration lets go half-way."""
    body = next(iter(SCENE.objects))
    pose = SCENE.objects[body]
    grips = dict.fromkeys(SIDES, Grip(body, Pose((0.1, 0.0, 0.0))))

    def keeps(scene: Scene, side: str) -> bool:
        return side == "left" and (scene.objects[body].position[2] == pose.position[2]) == kept

    plan = Plan(replace(reach("reach", grips), keeps=keeps), SCENE, QUIET, np.random.default_rng(0))
    plan.next()
    moved = replace(SCENE, objects=SCENE.objects | {body: pose.translated((0.0, 0.0, 0.1))})
    plan.follow(moved)
    rows = np.stack([plan.next() for _ in range(plan.primitive.frames - 1)])
    last = split_action(rows[-1])
    goal = grips["right"].tool(moved).translated((0.0, 0.0, 0.12))
    assert last["right"].pose.position == pytest.approx(goal.position)
    assert last["left"].pose.position == pytest.approx((SCENE.hands["left"].pose if kept else goal).position)
    assert (np.ptp(rows[:, :8], axis=0).max() == 0.0) == kept
