"""What is in a recording of an episode, and what made it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from hdril.env import BimanualEnv
from hdril.evaluation.evaluate import EvaluatedEpisode
from hdril.evaluation.identity import Identity, PolicyIdentity, identify_trials
from hdril.evaluation.reference import Reference
from hdril.evaluation.score import Outcome, score_episode
from hdril.rollout import Ending
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.trace import Trace, trace_episode
from hdril.viewer.recordings import recording_name, write_recording
from tests.evaluation.rerun_text import read_back, states, value_of, values_of

SUCCEEDED = Ending(True, "", 70)
IDENTITY = Identity(
    PolicyIdentity("act", "a" * 64, "b" * 64, "c" * 64, "cpu", {"torch": "2"}),
    identify_trials("table_lift", 940_000, 1),
)


@pytest.fixture(scope="module")
def played() -> tuple[BimanualEnv, Trace, Outcome]:
    """The expert's episode of a seed, judged against itself."""
    env = BimanualEnv("table_lift")
    trace, ending = trace_episode(env, ScriptedExpert(env.task_spec, Noise(0.0)), 940_000)
    return env, trace, score_episode(env.task_spec, 940_000, trace, Reference.of(env.task_spec, trace, ending), ending)


@pytest.mark.parametrize("ahead", [10, 1])
def test_recording_holds_robot_objects_paths_lanes_and_outcome(ahead: int, played, tmp_path: Path) -> None:
    env, trace, outcome = played
    failed = replace(outcome, success=False, unmet="table at rest")
    explanations = [replace(e, primitive=1, attention={"table": 0.5}) if e.primitive == 2 else
                    replace(e, attention={"table": 1.0}) for e in trace.explanations if e is not None]  # fmt: skip
    explanations[0] = replace(explanations[0], plan=trace.action[:ahead])
    wrong = replace(trace, explanations=tuple(explanations))
    path = write_recording(
        tmp_path, EvaluatedEpisode(env, failed, wrong, Reference.of(env.task_spec, trace, SUCCEEDED), IDENTITY)
    )
    assert path.name == "seed_0940000_failure.rrd"
    assert recording_name(outcome) == "seed_0940000_success"
    text = read_back(path)
    for entity in (
        "/world/table",
        "/world/platform",
        "/world/hands/left/commanded",
        "/world/hands/right/executed",
        "/world/hands/left/expert_path",
        "/robot/joints/left_s0",
        "/primitive/scripted",
        "/primitive/predicted",
        "/tracking_error_mm/left",
        "/planner/grasp",
        "/primitive/executed",
        "/from_expert_cm/left",
        "/attention/table",
        "/world/hands/right/plan",
        "/grip_force_N/right",
        "/ik_error_mm/left",
        "/contact/robot-table",
        "/contact/table-platform",
        "/progress/stage",
        "/reward",
        "/summary",
    ):
        assert f"entity_path: {entity} " in text, entity
    assert "failure: table at rest" in text
    summary = value_of(path, "/summary", "TextDocument:text")
    assert "Policy: act, weights aaaaaaaaaaaa, config bbbbbbbbbbbb." in summary
    assert json.loads(value_of(path, "/__properties/policy", "identity")) == IDENTITY.as_dict()
    assert not states(text, "/primitive/executed") & {"lift"}
    assert states(text, "/primitive/scripted") == set(env.task_spec.labels)


def test_events_are_named_and_bodies_that_move_are_drawn_where_they_were(played, tmp_path: Path) -> None:
    env, trace, outcome = played
    noticed = ((14, "grasp tried again"), (26, "grasp tried again"))
    disturbed = replace(outcome, events=((12, "platform_slide: platform (0.05 m)"),), noticed=noticed)
    slid = trace.poses["platform"].copy()
    slid[13:, 0] += 0.05
    moved = replace(trace, poses=trace.poses | {"platform": slid})
    path = write_recording(
        tmp_path, EvaluatedEpisode(env, disturbed, moved, Reference.of(env.task_spec, moved, SUCCEEDED))
    )
    assert "platform_slide: platform (0.05 m)" in values_of(path, "/log", "TextLog:text")
    assert values_of(path, "/log", "TextLog:text").count("grasp tried again") == 2
    summary = value_of(path, "/summary", "TextDocument:text")
    assert "**platform_slide: platform (0.05 m) at 1.2 s.**" in summary
    assert "Noticed: grasp tried again at 1.4 s, 2.6 s." in summary
    drawn = values_of(path, "/world/platform", "Transform3D:translation")
    assert len(drawn) == len(trace.state)
    assert drawn[-1][0] - drawn[0][0] == pytest.approx(0.05, abs=1e-6)
    assert len(values_of(path, "/world/bench", "Transform3D:translation")) == 1, "it does not move"
