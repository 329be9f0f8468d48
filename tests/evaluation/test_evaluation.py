"""Traces, recordings, and held-out seeds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hdril.demonstrations.provenance import Provenance, Recipe
from hdril.env import BimanualEnv
from hdril.evaluation.evaluate import EvaluatedEpisode
from hdril.evaluation.held_out import check_held_out, training_provenance
from hdril.evaluation.reference import Reference, ReferenceCache
from hdril.evaluation.score import Outcome, score_episode
from hdril.rollout import Ending
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.trace import Trace, trace_episode
from hdril.viewer.recordings import recording_name, write_recording
from tests.evaluation.rerun_text import read_back, states

SUCCEEDED = Ending(True, "", 70)


@pytest.fixture(scope="module")
def played() -> tuple[BimanualEnv, Trace, Outcome]:
    """The expert's episode of a seed, judged against itself."""
    env = BimanualEnv("table_lift")
    trace, ending = trace_episode(env, ScriptedExpert(env.task_spec, Noise(0.0)), 940_000)
    return env, trace, score_episode(env.task_spec, 940_000, trace, Reference.of(trace, ending), ending)


def test_the_expert_has_no_error_against_itself(played) -> None:
    env, trace, outcome = played
    assert outcome.position_error_cm == 0.0
    assert outcome.primitives == tuple(p.name for p in env.task_spec.primitives)
    assert set(outcome.position_error_cm_by_primitive) == set(env.task_spec.labels)
    assert trace.state.shape == (71, 16)
    assert trace.joints.shape == (71, 18)
    assert trace.grip_force.shape == (71, 2)
    assert (trace.grip_force[0] == 0.0).all()
    assert (trace.grip_force[30] > 20.0).all(), "the hands hold the table"
    assert trace.contacts["robot, table"][30]
    assert not trace.contacts["robot, table"][-1]
    assert trace.contacts["table, platform"][-1]
    assert trace.ik_error.max() < 2e-3


def test_the_experts_episode_is_played_once(played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env, trace, _ = played
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = ReferenceCache(env).get(940_000)
    np.testing.assert_array_equal(first.state, trace.state)
    monkeypatch.setattr("hdril.evaluation.reference.trace_episode", None)  # playing again would fail
    again = ReferenceCache(env).get(940_000)
    np.testing.assert_array_equal(again.state, first.state)
    np.testing.assert_array_equal(again.scripted, first.scripted)


def test_recording_holds_robot_objects_paths_lanes_and_outcome(played, tmp_path: Path) -> None:
    env, trace, outcome = played
    failed = replace(outcome, success=False, unmet="table at rest")
    explanations = [replace(e, primitive=1, attention={"table": 0.5}) if e.primitive == 2 else
                    replace(e, attention={"table": 1.0}) for e in trace.explanations if e is not None]  # fmt: skip
    explanations[0] = replace(explanations[0], plan=trace.action[:10])
    wrong = replace(trace, explanations=tuple(explanations))
    path = write_recording(tmp_path, EvaluatedEpisode(env, failed, wrong, Reference.of(trace, SUCCEEDED)))
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
    assert not states(text, "/primitive/executed") & {"lift"}
    assert states(text, "/primitive/scripted") == set(env.task_spec.labels)


def test_seeds_of_the_training_data_are_refused(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "train_config.json").write_text(
        json.dumps({"dataset": {"repo_id": "hdril/test", "root": str(dataset)}})
    )
    provenance = training_provenance(str(tmp_path))
    assert provenance is not None
    assert provenance.seeds == (0, 1, 2, 3, 4, 5)
    assert check_held_out(provenance, "table_lift", [6, 7])
    with pytest.raises(ValueError, match=r"2 of 4 seeds \(4 to 5\) were in the training data.*a seed above 5"):
        check_held_out(provenance, "table_lift", [4, 5, 6, 7])
    with pytest.raises(ValueError, match="trained on the task 'table_lift', not on 'other'"):
        check_held_out(Provenance(Recipe("table_lift"), (0,)), "other", [9])
    assert not check_held_out(training_provenance("user/elsewhere"), "table_lift", [0])
