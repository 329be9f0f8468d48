"""Scores of episodes that are made by hand: no simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hdril.evaluation.reference import Reference
from hdril.evaluation.score import DEPARTURE, Outcome, in_words, score_episode
from hdril.tasks import get_task
from hdril.trace import Trace
from tests.evaluation.synthetic import FAILED, SUCCEEDED, TASK, explanation, moved, reference, trace

ACROSS = (0.0, 0.0, 0.01)
BEYOND, WITHIN = (0.0, 0.0, DEPARTURE * 1.01), (0.0, 0.0, DEPARTURE * 0.99)


def score(episode: Trace, against: Reference | None = None) -> Outcome:
    return score_episode(TASK, 3, episode, against or reference(trace()), SUCCEEDED)


def test_the_expert_has_no_error_against_itself() -> None:
    outcome = score(trace())
    assert (outcome.position_error_cm, outcome.angle_error_rad, outcome.dtw_cm) == (0.0, 0.0, 0.0)
    assert outcome.position_error_cm_by_primitive == {"grasp": 0.0, "move": 0.0, "lift": 0.0}
    assert outcome.primitives == ("grasp", "move", "lift")
    assert (outcome.departed_frame, outcome.departed_in) == (-1, "")
    assert outcome.planner_confusion == [[2, 0, 0], [0, 2, 0], [0, 0, 2]]
    assert outcome.planner_boundary_hits == [True, True, True]
    assert outcome.expert_success


def test_the_ending_is_told() -> None:
    outcome = score_episode(TASK, 3, trace(), reference(trace()), SUCCEEDED)
    assert (outcome.seed, outcome.success, outcome.unmet, outcome.frames) == (3, True, "", 6)
    outcome = score_episode(TASK, 4, trace(), reference(trace()), FAILED)
    assert (outcome.seed, outcome.success, outcome.unmet) == (4, False, "table upright")
    outcome = score_episode(TASK, 4, trace(), reference(trace(), success=False), SUCCEEDED)
    assert (outcome.success, outcome.expert_success) == (True, False)


def test_what_the_policy_noticed_is_told_by_frame() -> None:
    explanations = [None, *(replace(explanation(k), events=words) for k, words in enumerate(((), ("a", "b"), ("a",))))]
    outcome = score(trace((0, 0, 1, 2), explanations=explanations))
    assert outcome.noticed == ((2, "a"), (2, "b"), (3, "a"))
    assert in_words(outcome.noticed, 0.1) == "a at 0.2 s, 0.3 s; b at 0.2 s"
    assert score(trace()).noticed == ()
    assert in_words((), 0.1) == ""
    often = [(frame, "a") for frame in range(10, 17)]
    assert in_words(often[:6], 0.1) == "a at 1.0 s, 1.1 s, 1.2 s, 1.3 s, 1.4 s, 1.5 s"
    assert in_words(often, 0.1) == "a at 1.0 s, 1.1 s, 1.2 s, 1.3 s, 1.4 s, and 2 times more until 1.6 s"


def test_the_experts_jerk_is_that_of_its_hands() -> None:
    """A hand of the expert stands still but for one jump of 1 cm: third differences of 1, -2 and 1 cm."""
    assert score(trace()).expert_jerk_m_s3 == pytest.approx(0.0, abs=1e-2)
    jumps = trace()
    jumps.state[:, 0::8] = 0.0
    jumps.state[3:, 0] = 0.01
    expected = (6 * (0.01 / TASK.physics.control_period**3) ** 2 / (2 * 4)) ** 0.5
    outcome = score(trace(), reference(jumps))
    assert outcome.expert_jerk_m_s3 == pytest.approx(expected, rel=1e-4)
    assert outcome.expert_jerk_m_s3 != outcome.motion["jerk_m_s3"]


def test_failures_of_inverse_kinematics_are_counted_by_frame() -> None:
    failing = replace(trace(), ik_failures=("", "left", "left, right", "", "", ""))
    assert score(failing).ik_failures == 2


def test_errors_are_in_centimetres_and_radians() -> None:
    """One hand of two is 1 cm away and turned by 0.2 rad: the means are half of that."""
    away = moved(trace(), 0, ACROSS, hand=1)
    away.state[:, 8 + 3 : 8 + 7] = [0.0, 0.0, np.sin(0.1), np.cos(0.1)]
    outcome = score(away)
    assert outcome.position_error_cm == pytest.approx(0.5, rel=1e-5)
    assert outcome.dtw_cm == pytest.approx(0.5, rel=1e-5)
    assert outcome.angle_error_rad == pytest.approx(0.1, rel=1e-5)


def test_errors_are_means_over_frames() -> None:
    """The same in the last three of seven rows alone."""
    away = moved(trace(), 4, ACROSS, hand=1)
    away.state[4:, 8 + 3 : 8 + 7] = [0.0, 0.0, np.sin(0.1), np.cos(0.1)]
    outcome = score(away)
    assert outcome.position_error_cm == pytest.approx(0.5 * 3 / 7, rel=1e-5)
    assert outcome.angle_error_rad == pytest.approx(0.1 * 3 / 7, rel=1e-5)


def test_an_error_belongs_to_the_primitive_whose_action_led_to_it() -> None:
    """Rows 3 and 4 are where the actions of frames 2 and 3 led, which are move; the last row is where lift ends."""
    away = moved(moved(trace(), 3, ACROSS, hand=0), 5, (0.0, 0.0, -0.01), hand=0)
    errors = score(away).position_error_cm_by_primitive
    assert errors == pytest.approx({"grasp": 0.0, "move": 0.5, "lift": 0.0}, abs=1e-5)
    half = moved(trace(), 6, ACROSS, hand=0)
    assert score(half).position_error_cm_by_primitive["lift"] == pytest.approx(0.25, rel=1e-5)


def test_primitives_that_were_not_reached_have_no_error() -> None:
    short = trace((0, 0, 1))
    assert set(score(short).position_error_cm_by_primitive) == {"grasp", "move"}


def test_frames_beyond_the_experts_last_belong_to_no_primitive() -> None:
    longer = moved(trace((0, 0, 1, 1, 2, 2, -1, -1)), 7, (0.5, 0.0, 0.0), hand=0)
    outcome = score(longer)
    assert outcome.position_error_cm == 0.0
    assert outcome.departed_frame == -1
    assert np.sum(outcome.planner_confusion) == 6
    assert outcome.planner_boundary_hits == [True, True, True]


def test_start_positions_are_those_of_all_objects_before_the_first_frame() -> None:
    two = get_task("peg_in_hole")
    episode = trace((0, 0), explanations=[None, None], task=two)
    episode.poses[two.observed[1]][:, 0] += 0.12344
    episode.environment_state[:] = 9.0  # what was observed may be late and noisy
    outcome = score_episode(two, 0, episode, reference(episode, task=two), FAILED)
    assert outcome.start == (0.0, 0.0, 0.1234, 1.0)


@pytest.mark.parametrize(("reached", "name"), [(0, ""), (1, "left half placed"), (4, "gap closed"), (5, "success")])
def test_the_last_stage_and_the_last_measures_are_told(reached: int, name: str) -> None:
    task = get_task("peg_in_hole")
    episode = trace((0, 0, 1), explanations=[None] * 3, task=task)
    episode.stage[-1] = reached
    episode.measures[:, 1] = [9.0, 9.0, 9.0, 0.1234567]
    outcome = score_episode(task, 0, episode, reference(episode, task=task), FAILED)
    assert (outcome.stage, outcome.stages) == (name, reached)
    assert outcome.measures == {"gap_mm": 0.0, "insertion_mm": 0.12346, "offset_mm": 0.0}


# -------------------------------------------------------------- what was played


def test_a_primitive_is_listed_each_time_that_it_begins() -> None:
    played = [explanation(k) for k in (0, 1, 1, 0, 0, 2)]
    assert score(trace(explanations=played)).primitives == ("grasp", "move", "grasp", "lift")
    assert score(trace(explanations=played)).expert_primitives == ("grasp", "move", "lift")


def test_primitives_that_the_task_lacks_are_not_listed() -> None:
    unknown = explanation(-1, (0.0, 0.0, 0.0))
    assert score(trace(explanations=[unknown, explanation(1), *[unknown] * 4])).primitives == ("move",)
    assert score(trace(explanations=[None] * 6)).primitives == ()


# ------------------------------------------------------------------- departure


@pytest.mark.parametrize("hand", [0, 1, None])
def test_departure_is_the_frame_whose_end_is_too_far_away(hand: int | None) -> None:
    outcome = score(moved(trace(), 4, BEYOND, hand))
    assert (outcome.departed_frame, outcome.departed_in) == (3, "move")
    assert score(moved(trace(), 4, WITHIN, hand)).departed_frame == -1


def test_an_episode_that_starts_elsewhere_departs_at_its_first_frame() -> None:
    outcome = score(moved(trace(), 0, BEYOND, None))
    assert (outcome.departed_frame, outcome.departed_in) == (0, "grasp")


def test_departure_is_found_in_frames_that_both_have() -> None:
    assert score(moved(trace((0, 0, 1, 1, 2, 2, -1)), 7, BEYOND, 0)).departed_frame == -1
    assert score(moved(trace((0, 0, 1)), 3, BEYOND, 0)).departed_frame == 2


@pytest.mark.parametrize(
    ("played", "name"),
    [(explanation(0), "grasp"), (explanation(2), "lift"), (None, "move"), (explanation(-1, (0.0, 0.0, 0.0)), "move")],
)
def test_departure_names_the_policys_primitive_or_else_the_experts(played: Any, name: str) -> None:
    assert score(moved(trace(explanations=[played] * 6), 3, BEYOND, 0)).departed_in == name


def test_departure_in_no_primitive_at_all_has_no_name() -> None:
    away = moved(trace((0, -1, -1), explanations=[None] * 3), 3, BEYOND, 0)
    assert (score(away).departed_frame, score(away).departed_in) == (2, "")


# --------------------------------------------------------------------- planner


def test_the_planner_is_scored_by_what_it_prefers_not_by_what_plays() -> None:
    explanations = [explanation(k) for k in (0, 0, 1, 1, 2, 2)]
    explanations[2] = explanation(1, (0.1, 0.3, 0.6))  # the first frame of move
    explanations[5] = explanation(2, (0.2, 0.5, 0.3))  # the last frame of lift
    outcome = score(trace(explanations=explanations))
    assert outcome.planner_confusion == [[2, 0, 0], [0, 1, 1], [0, 1, 1]]
    assert outcome.planner_boundary_hits == [True, False, True]


def test_a_primitive_that_comes_back_has_a_boundary_each_time() -> None:
    outcome = score(trace((0, 1, 0, -1, 0, 2)))
    assert outcome.planner_boundary_hits == [True] * 5
    assert outcome.planner_confusion == [[3, 0, 0], [0, 1, 0], [0, 0, 1]]


@pytest.mark.parametrize("odd", [None, explanation(-1, (0.0, 0.0, 0.0)), explanation(1, (0.0, 0.6, 0.3))])
def test_a_planner_is_scored_only_if_it_chooses_among_the_tasks_primitives_at_every_frame(odd: Any) -> None:
    explanations = [explanation(k) for k in (0, 0, 1, 1, 2)]
    outcome = score(trace(explanations=[*explanations, odd]))
    assert (outcome.planner_confusion, outcome.planner_boundary_hits) == ([], [])


def test_rounding_of_probabilities_hides_no_planner() -> None:
    rounded = [explanation(0, (0.6, 0.2999, 0.0999))] * 6
    assert score(trace(explanations=rounded)).planner_confusion == [[2, 0, 0], [2, 0, 0], [2, 0, 0]]


def test_a_planner_that_knows_none_of_the_tasks_primitives_prefers_none() -> None:
    """The first primitive is no default: with all probabilities 0 there is no most probable one."""
    odd = explanation(-1, (0.0, 0.0, 0.0))
    played = trace(explanations=[odd, explanation(0), None, explanation(2), explanation(0, (0.2, 0.5, 0.3)), odd])
    assert played.predicted.tolist() == [-1, 0, -1, 2, 1, -1]
