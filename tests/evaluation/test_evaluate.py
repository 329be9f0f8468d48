"""Episodes of policies against the expert's: references, budgets, primitives of another task, workers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hdril.cli.eval import EvalConfig, PolicySource, eval_command
from hdril.env import BimanualEnv
from hdril.evaluation.evaluate import Worker, evaluate, make_job
from hdril.evaluation.reference import ReferenceCache
from hdril.evaluation.score import score_episode
from hdril.rollout import Ending
from hdril.trace import Trace
from tests.evaluation.checkpoints import experts_episode, save_hdril, save_replay

SEED = 940_000


@pytest.fixture(scope="module")
def expert() -> Trace:
    return experts_episode(SEED)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of the expert's episodes."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def config_of(policy: Path, output: Path, **options) -> EvalConfig:
    return EvalConfig(
        PolicySource(str(policy)), **{"num_episodes": 1, "seed": SEED, "workers": 1, "output_dir": output, **options}
    )


def results_of(output: Path) -> dict:
    return json.loads((output / "results.json").read_text())


def test_the_expert_has_no_error_against_itself(expert: Trace, cache: Path) -> None:
    env = BimanualEnv("table_lift")
    reference = ReferenceCache("table_lift").get(SEED)
    outcome = score_episode(env.task_spec, SEED, expert, reference, Ending(True, "", 70))
    assert outcome.position_error_cm == outcome.angle_error_rad == outcome.dtw_cm == 0.0
    assert outcome.primitives == tuple(p.name for p in env.task_spec.primitives)
    assert set(outcome.position_error_cm_by_primitive) == set(env.task_spec.labels)
    assert expert.state.shape == (71, 16)
    assert expert.joints.shape == (71, 18)
    assert expert.grip_force.shape == (71, 2)
    assert (expert.grip_force[0] == 0.0).all()
    assert (expert.grip_force[30] > 20.0).all(), "the hands hold the table"
    assert expert.contacts["robot, table"][30]
    assert not expert.contacts["robot, table"][-1]
    assert expert.contacts["table, platform"][-1]
    assert expert.ik_error.max() < 2e-3


def test_the_experts_episode_is_played_once(expert: Trace, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = ReferenceCache("table_lift").get(SEED)
    np.testing.assert_array_equal(first.state, expert.state)
    assert (first.success, first.unmet) == (True, "")
    monkeypatch.setattr("hdril.evaluation.reference.trace_episode", None)  # playing again would fail
    again = ReferenceCache("table_lift").get(SEED)
    for name, value in vars(first).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    for name, value in (("pybullet", "0"), ("robot model", "another"), ("hdril", "0 (another source)")):
        software = {"pybullet": "3", "robot model": "one", "hdril": "0"} | {name: value}
        monkeypatch.setattr("hdril.evaluation.reference.episode_software", lambda task, s=software: s)
        with pytest.raises(TypeError):  # it is to be played anew
            ReferenceCache("table_lift").get(SEED)


def test_a_seed_that_the_expert_fails_on_is_counted_and_left_out(
    expert: Trace, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = replace(ReferenceCache("table_lift").get(SEED), success=False, unmet="table upright")
    monkeypatch.setattr(ReferenceCache, "get", lambda self, seed: reference)
    eval_command(config_of(save_replay(tmp_path / "p", expert.action), tmp_path / "eval"))
    results = results_of(tmp_path / "eval")
    assert results["per_episode"][0]["expert_success"] is False
    assert results["n_expert_failures"] == 1
    assert results["position_error_cm"] is None
    assert "The expert fails on all 1 seeds" in (tmp_path / "eval/report.md").read_text()


def test_max_frames_give_a_policy_time(expert: Trace, cache: Path, tmp_path: Path) -> None:
    """A policy that waits 30 frames before it does what the expert does: too late for the horizon, in time for 110."""
    late = save_replay(tmp_path / "late", np.concatenate([expert.action[:1].repeat(30, 0), expert.action]))
    eval_command(config_of(late, tmp_path / "short", rerun="none"))
    eval_command(config_of(late, tmp_path / "long", rerun="none", max_frames=110))
    short, long = results_of(tmp_path / "short"), results_of(tmp_path / "long")
    assert (short["n_success"], short["per_episode"][0]["frames"], short["max_frames"]) == (0, 70, 0)
    assert long["n_success"] == 1
    assert long["max_frames"] == long["identity"]["trials"]["max_frames"] == 110
    assert 70 < long["per_episode"][0]["frames"] <= 110
    assert "110 frames at most" in (tmp_path / "long/report.md").read_text()
    assert "frames at most" not in (tmp_path / "short/report.md").read_text()


def test_planner_of_another_task_is_not_scored(expert: Trace, cache: Path, tmp_path: Path) -> None:
    """The same policy, with primitives of the task's names, and with one of another name."""
    names = ["grasp", "move", "lift", "extend", "place", "retract"]
    for name, primitives in (("own", names), ("foreign", ["juggle", *names[1:]])):
        policy = save_replay(tmp_path / name, expert.action, primitives=primitives, labels=expert.scripted.tolist())
        eval_command(config_of(policy, tmp_path / f"eval_{name}", rerun="none"))
    own, foreign = results_of(tmp_path / "eval_own"), results_of(tmp_path / "eval_foreign")
    assert own["planner"]["pc_correct"] == own["pc_expert_order"] == 100.0
    assert own["notes"] == []
    assert foreign["n_success"] == own["n_success"] == 1
    assert foreign["planner"] is None
    assert foreign["pc_expert_order"] is None
    note = "Not of this task are the policy's primitives juggle: its planner is not scored."
    assert note in (tmp_path / "eval_foreign/report.md").read_text()


def test_two_policies_are_compared_seed_by_seed(expert: Trace, cache: Path, tmp_path: Path) -> None:
    good = save_replay(tmp_path / "good", expert.action)
    still = save_replay(tmp_path / "still", expert.action[:1])
    eval_command(config_of(still, tmp_path / "other", rerun="none"))
    eval_command(config_of(good, tmp_path / "eval", rerun="none", against=tmp_path / "other"))
    comparison = results_of(tmp_path / "eval")["comparison"]
    assert comparison["against"] == str(still)
    assert (comparison["first_only"], comparison["second_only"]) == (1, 0)
    assert comparison["pc_difference"] == 100.0
    assert "## Comparison" in (tmp_path / "eval/report.md").read_text()


@pytest.mark.portable
def test_outcomes_do_not_depend_on_workers(dataset: Path, cache: Path, tmp_path: Path) -> None:
    policy = save_hdril(tmp_path / "policy", dataset)
    job = make_job("table_lift", str(policy), SEED, 2)
    assert list(evaluate(job, job.seeds, 1)) == list(evaluate(job, job.seeds, 2))


def test_a_worker_plays_a_seed_as_the_evaluation_did(expert: Trace, cache: Path, tmp_path: Path) -> None:
    job = make_job("table_lift", str(save_replay(tmp_path / "p", expert.action)), SEED, 1)
    worker = Worker(job)
    episode = worker.play(SEED)
    worker.env.close()
    assert episode.identity == job.identity
    assert episode.env is worker.env  # its world is that of the last frame: recordings take the robot from it
    assert episode.outcome.success
    assert episode.outcome.position_error_cm == 0.0
    np.testing.assert_array_equal(episode.trace.state, expert.state)
