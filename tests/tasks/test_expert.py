"""What the scripted expert decides from what it sees; without a simulator, but for the last tests."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from hdril.actor import Decision, Observation
from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.rollout import run_episode, transitions
from hdril.simulation.actions import HandCommand, hand_slice, join_action, split_action
from hdril.simulation.robots import SIDES
from hdril.tasks import get_task
from hdril.tasks.events import Event
from hdril.tasks.expert import HOLD, LAG, ScriptedExpert
from hdril.tasks.primitives import Grip, Hands, Need, Noise, Primitive, Scene, Segment, grasp
from hdril.tasks.table_lift import TASK
from hdril.tasks.task import Task

DOWN = (0.0, 1.0, 0.0, 0.0)
REST = {side: HandCommand(Pose((0.5, y, 0.5), DOWN), 1.0) for side, y in zip(SIDES, (0.3, -0.3), strict=True)}
GRIPS = {side: Grip("table", Pose((0.0, y, 0.3), DOWN)) for side, y in zip(SIDES, (0.4, -0.4), strict=True)}


def stay(name: str, frames: int, rise: float = 0.01) -> Primitive:
    """Both hands rise a little."""

    def goal(scene: Scene) -> Hands:
        return {s: HandCommand(h.pose.translated((0.0, 0.0, rise)), h.opening) for s, h in scene.hands.items()}

    return Primitive(name, (Segment(frames, goal),))


def x_above(limit: float) -> Need:
    return Need(f"x > {limit:g}", lambda scene: bool(scene.objects["table"].position[0] > limit))


class Stage:
    """A robot that is where it is told to be, and a table that is moved by the test."""

    def __init__(self, task: Task, seed: int = 0, noise: float = 0.0) -> None:
        self.task, self.expert = task, ScriptedExpert(task, Noise(noise))
        self.expert.reset(seed)
        self.hands, self.table = join_action(REST), Pose((0.6, 0.0, 0.0))

    def observation(self) -> Observation:
        table = self.table.as_vector().astype(np.float32)
        return {"agent_pos": self.hands.astype(np.float32), "environment_state": table}

    def step(self, obeys: bool = True) -> Decision:
        decision = self.expert.act(self.observation())
        if obeys:
            self.hands = np.asarray(decision.action, np.float64)
        return decision

    def labels(self, frames: int) -> list[tuple[str, bool]]:
        """Name of the primitive, and whether it starts, of each of the next frames."""
        steps = [self.step().explanation for _ in range(frames)]
        return [(self.task.labels[step.primitive], step.starts) for step in steps if step is not None]


def script(*primitives: Primitive, **changes: object) -> Task:
    return replace(TASK, primitives=primitives, **({"recovery": (), "dwell": 3} | changes))


def runs(labels: list[tuple[str, bool]]) -> list[tuple[str, int]]:
    """Primitives with their lengths, cut where one starts."""
    found: list[tuple[str, int]] = []
    for name, starts in labels:
        if starts:
            found.append((name, 0))
        assert found[-1][0] == name
        found[-1] = (name, found[-1][1] + 1)
    return found


# ---------------------------------------------------------------------- order


def test_primitives_are_played_in_order_with_their_lengths_and_starts() -> None:
    stage = Stage(script(stay("a", 3), stay("b", 4), stay("a", 2)))
    assert runs(stage.labels(9)) == [("a", 3), ("b", 4), ("a", 2)]


def test_a_primitive_that_is_played_twice_in_a_row_starts_twice() -> None:
    stage = Stage(script(stay("a", 3), stay("a", 3)))
    assert [starts for _, starts in stage.labels(6)] == [True, False, False] * 2


def test_what_is_superfluous_is_skipped() -> None:
    skipped = stay("b", 4).needing(unless=x_above(0.5))
    assert runs(Stage(script(stay("a", 3), skipped, stay("c", 2))).labels(5)) == [("a", 3), ("c", 2)]
    stage = Stage(script(stay("a", 3), skipped, stay("c", 2)))
    stage.table = Pose((0.4, 0.0, 0.0))
    assert runs(stage.labels(9)) == [("a", 3), ("b", 4), ("c", 2)]


# ---------------------------------------------------------------------- mishaps


def test_it_goes_back_where_a_primitive_is_not_possible_and_says_so() -> None:
    task = script(stay("a", 3), stay("b", 2).needing(x_above(0.5)), stay("c", 2), recovery=(stay("c", 2),))
    stage = Stage(task)
    stage.labels(2)
    stage.table = Pose((0.4, 0.0, 0.0))
    stage.step()
    decision = stage.step()
    assert decision.explanation is not None
    assert decision.explanation.events == ("back to a: b is not possible",)
    assert task.labels[decision.explanation.primitive] == "c"
    stage.table = Pose((0.6, 0.0, 0.0))
    assert runs([("c", True), *stage.labels(8)]) == [("c", 2), ("a", 3), ("b", 2), ("c", 2)]


def test_what_has_no_label_is_left_out_of_the_recovery() -> None:
    """A copy of a task that has other primitives keeps the first one's recovery."""
    task = script(stay("a", 3), stay("b", 2).needing(x_above(0.5)), recovery=(stay("wave", 2), stay("b", 1)))
    stage = Stage(task)
    stage.labels(2)
    stage.table = Pose((0.4, 0.0, 0.0))
    assert stage.labels(5) == [("a", False), ("b", True), ("a", True), ("a", False), ("a", False)]


def test_a_primitive_is_given_up_when_a_need_is_missing_for_two_frames() -> None:
    task = script(stay("a", 2), stay("b", 6).needing(x_above(0.5)))
    stage = Stage(task)
    stage.labels(4)
    stage.table = Pose((0.4, 0.0, 0.0))
    assert stage.labels(1) == [("b", False)]
    decision = stage.step()
    assert decision.explanation is not None
    assert decision.explanation.events == ("gave up b: not x > 0.5", "back to a: b is not possible")
    assert decision.explanation.starts


def test_one_frame_without_a_need_is_forgiven() -> None:
    stage = Stage(script(stay("a", 2), stay("b", 6).needing(x_above(0.5))))
    stage.labels(4)
    stage.table = Pose((0.4, 0.0, 0.0))
    labels = stage.labels(1)
    stage.table = Pose((0.6, 0.0, 0.0))
    assert labels + stage.labels(3) == [("b", False)] * 4


def test_it_goes_back_to_the_last_primitive_that_is_possible() -> None:
    task = script(stay("a", 2), stay("b", 2), stay("c", 2), stay("d", 2).needing(x_above(0.5)))
    stage = Stage(task)
    stage.labels(5)
    stage.table = Pose((0.4, 0.0, 0.0))
    stage.step()
    assert stage.labels(1) == [("c", True)]


def test_what_is_needed_to_begin_may_differ_from_what_is_needed_to_go_on() -> None:
    begun = stay("b", 3).needing(x_above(0.5), before=(x_above(0.7),))
    stage = Stage(script(stay("a", 2), begun))
    assert stage.labels(3) == [("a", True), ("a", False), ("a", True)]  # x is 0.6
    stage.table = Pose((0.8, 0.0, 0.0))
    stage.labels(1)
    assert stage.labels(1) == [("b", True)]
    stage.table = Pose((0.6, 0.0, 0.0))
    assert stage.labels(2) == [("b", False)] * 2


def test_nothing_that_can_be_done_ends_the_episode() -> None:
    stage = Stage(script(stay("a", 2).needing(x_above(0.5))))
    stage.table = Pose((0.4, 0.0, 0.0))
    with pytest.raises(StopIteration, match="nothing can be done for a"):
        stage.step()


def test_after_a_mishap_it_plans_from_where_a_hindered_hand_is() -> None:
    """A command that runs ahead of a stopped arm would be a blow when the arm is free again."""
    task = script(stay("a", 4, rise=0.2), stay("b", 2).needing(x_above(0.5)))
    stage = Stage(task)
    for _ in range(3):
        stage.step()
    stage.table = Pose((0.4, 0.0, 0.0))
    stage.step(obeys=False)
    held = stage.hands.copy()
    held[hand_slice("left")][:3] -= (0.0, 0.0, 0.15)
    stage.hands = held
    hands = split_action(np.asarray(stage.step().action))
    measured = split_action(held)
    assert abs(hands["left"].pose.position[2] - measured["left"].pose.position[2]) < 0.05
    # The right hand was where it was told to be, but for the last frame: its plan goes on from the command.
    assert hands["right"].pose.position[2] > measured["right"].pose.position[2]


# ---------------------------------------------------------------------- following, waiting, noise


def test_it_follows_an_object_that_moves_within_a_primitive() -> None:
    stage = Stage(script(grasp(GRIPS)))
    labels = stage.labels(4)
    stage.table = Pose((0.65, 0.05, 0.0))
    labels += stage.labels(6)
    assert runs(labels) == [("grasp", 10)]
    hands = split_action(stage.hands)
    for side, grip in GRIPS.items():
        assert hands[side].opening == 0.0
        assert hands[side].pose.position == pytest.approx((stage.table @ grip.pose).position, abs=1e-6)  # pyright: ignore


def test_it_waits_for_the_dwell_and_then_goes_back() -> None:
    stage = Stage(script(stay("a", 2), stay("b", 2), dwell=3))
    stage.labels(4)
    last = stage.hands.copy()
    assert stage.labels(3) == [("b", False)] * 3
    np.testing.assert_array_equal(stage.hands, last)
    decision = stage.step()
    assert decision.explanation is not None
    assert decision.explanation.events == ("back to b: success is not possible",)


def test_it_waits_for_the_horizon_where_its_plan_is_over_sooner() -> None:
    """Success is not judged before. To play the last primitive again would undo it."""
    short = replace(stay("b", 3), unless=x_above(0.5))
    stage = Stage(script(stay("a", 2), short, stay("c", 2), dwell=1))
    assert stage.task.horizon == 7
    assert runs(stage.labels(7)) == [("a", 2), ("c", 5)]
    decision = stage.step()
    assert decision.explanation is not None
    assert decision.explanation.events == ("back to c: success is not possible",)


def hinder(stage: Stage, distance: float) -> Decision:
    """A frame in which the left hand does not go all the way."""
    decision = stage.step()
    stage.hands = stage.hands.copy()
    stage.hands[hand_slice("left")][:3] -= (0.0, 0.0, distance)
    return decision


def test_hands_that_carry_wait_for_one_that_is_held_up() -> None:
    stage = Stage(script(grasp(GRIPS), stay("carry", 20)))
    stage.labels(11)
    first = hinder(stage, 0.05)
    waiting = [hinder(stage, 0.05 * (i == 0)) for i in range(2)]
    np.testing.assert_array_equal(waiting[0].action, first.action)
    assert waiting[0].explanation is not None
    assert not waiting[0].explanation.starts
    # The hand has arrived: on with the plan.
    after = stage.step()
    assert np.abs(np.asarray(after.action) - first.action).max() > 1e-4
    assert after.explanation is not None
    assert (after.explanation.primitive, after.explanation.starts) == (1, False)


def test_they_do_not_wait_forever_and_not_for_small_things() -> None:
    stage = Stage(script(grasp(GRIPS), stay("carry", 20)))
    stage.labels(11)
    actions = np.array([hinder(stage, 0.05).action for _ in range(HOLD + 3)])
    still = (np.abs(np.diff(actions, axis=0)).max(axis=1) < 1e-9).tolist()
    assert still == [True] * HOLD + [False] * 2
    stage = Stage(script(grasp(GRIPS), stay("carry", 20)))
    stage.labels(11)
    actions = np.array([hinder(stage, LAG / 2).action for _ in range(4)])
    assert (np.abs(np.diff(actions, axis=0)).max(axis=1) > 1e-5).all()


def test_hands_that_hold_nothing_do_not_wait() -> None:
    """A hand that comes from far is late when a grasp begins: it closes all the same."""
    for primitive in (stay("reach", 8), grasp(GRIPS)):
        stage = Stage(script(primitive))
        stage.labels(2)
        actions = np.array([hinder(stage, 0.1).action for _ in range(5)])
        assert (np.abs(np.diff(actions, axis=0)).max(axis=1) > 1e-5).all()


def test_the_seed_decides_the_noise() -> None:
    def actions(seed: int) -> np.ndarray:
        stage = Stage(script(stay("a", 4), stay("b", 4)), seed, noise=0.004)
        return np.stack([stage.step().action for _ in range(8)])

    np.testing.assert_array_equal(actions(1), actions(1))
    assert np.abs(actions(1) - actions(2)).max() > 1e-4


# ---------------------------------------------------------------------- in the simulator


def _open_fingers(frame: int, frames: int) -> tuple[Event, ...]:
    return (Event("open_hand", "open_hand", frame, frames, "left"),)


def test_a_missed_grasp_is_tried_again() -> None:
    env = BimanualEnv("table_lift:open_hand=1")
    with closing(env):
        scenario = replace(env.task_spec.sample(930_000), events=_open_fingers(7, 5))
        names, info = [], {}
        for transition in transitions(env, ScriptedExpert(env.task_spec, Noise(0.0)), 930_000, scenario=scenario):
            explanation, info = transition.decision.explanation, transition.info
            assert explanation is not None
            names += [env.task_spec.labels[explanation.primitive]] if explanation.starts else []
        assert info["is_success"]
    assert names[:3] == ["grasp", "retract", "grasp"]
    assert names[3:8] == ["move", "lift", "extend", "place", "retract"]


def test_it_gives_up_at_the_budget() -> None:
    env = BimanualEnv("table_lift:open_hand=1")
    with closing(env):
        scenario = replace(env.task_spec.sample(930_000), events=_open_fingers(0, 1000))
        ending = run_episode(env, ScriptedExpert(env.task_spec, Noise(0.0)), 930_000, scenario=scenario)
        assert (ending.success, ending.frames) == (False, env.task_spec.budget)
    assert get_task("table_lift:open_hand=1").budget == 3 * TASK.horizon
