"""Mishaps in the first grasp: the robot does something else, the policy answers as it would."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hdril.cli.eval import EvalConfig, PolicySource, eval_command
from hdril.evaluation.evaluate import Worker, make_job
from hdril.evaluation.identity import identify_trials
from hdril.evaluation.mishap import MISHAPS, first_grasp_ends
from hdril.evaluation.reference import ReferenceCache
from hdril.evaluation.stored import read_evaluation
from hdril.simulation.actions import hand_slice
from hdril.simulation.robots.spec import SIDES
from hdril.tasks import TASKS, get_task
from hdril.trace import Trace
from tests.evaluation.checkpoints import experts_episode, listing, save_replay

SEED = 940_000
AFTER = 10
"""Frames of the expert's first grasp."""


@pytest.fixture(scope="module")
def expert() -> Trace:
    return experts_episode(SEED)


@pytest.fixture(scope="module")
def policy(expert: Trace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_replay(tmp_path_factory.mktemp("policy") / "p", expert.action)


def play(policy: Path, mishap: str) -> Trace:
    worker = Worker(make_job("table_lift", str(policy), SEED, 1, mishap=mishap))
    trace = worker.play(SEED).trace
    worker.env.close()
    return trace


def heights(trace: Trace, frame: int) -> np.ndarray:
    return np.array([trace.state[frame, hand_slice(side)][2] for side in SIDES])


def fingers(trace: Trace, frame: int) -> np.ndarray:
    return np.array([trace.state[frame, hand_slice(side)][-1] for side in SIDES])


@pytest.mark.parametrize("mishap", MISHAPS)
def test_the_robot_is_misled_and_the_policy_is_not(policy: Path, expert: Trace, mishap: str) -> None:
    spoilt = play(policy, mishap)
    np.testing.assert_array_equal(spoilt.action[: len(expert.action)], expert.action)
    assert np.abs(spoilt.state[AFTER] - expert.state[AFTER]).max() > 0.03, "m, or the width of an open hand"


def test_what_each_mishap_does(policy: Path, expert: Trace) -> None:
    stay, opened, high = (play(policy, name) for name in ("hands_stay", "fingers_open", "hands_high"))
    assert np.abs(stay.state[AFTER] - stay.state[0]).max() < 0.01
    np.testing.assert_allclose(fingers(opened, AFTER), 1.0, atol=0.05)
    np.testing.assert_allclose(opened.state[AFTER // 2], expert.state[AFTER // 2], atol=1e-6)  # until fingers close
    assert (fingers(expert, AFTER) < 0.9).all()
    np.testing.assert_allclose(heights(high, AFTER), heights(expert, AFTER) + 0.06, atol=0.01)


def test_it_ends_with_the_first_primitive(policy: Path, expert: Trace) -> None:
    spoilt = play(policy, "hands_stay")
    assert np.abs(spoilt.state[AFTER + 5] - spoilt.state[AFTER]).max() > 0.03


def test_an_evaluation_says_what_happened(policy: Path, tmp_path: Path) -> None:
    def evaluate(mishap: str) -> dict:
        output = tmp_path / (mishap or "calm")
        eval_command(EvalConfig(PolicySource(str(policy)), num_episodes=1, seed=SEED, workers=1, output_dir=output,
                                rerun="none", mishap=mishap))  # fmt: skip
        return json.loads((output / "results.json").read_text())

    calm, spoilt = evaluate(""), evaluate("hands_high")
    assert (calm["n_success"], calm["max_frames"]) == (1, 0)
    assert (spoilt["n_success"], spoilt["max_frames"]) == (0, 3 * get_task("table_lift").horizon)
    assert spoilt["identity"]["trials"]["mishap"] == "hands_high"
    report = (tmp_path / "hands_high/report.md").read_text()
    assert (
        "Until the expert's first grasp of the scene would be over, the hands arrive 6 cm too high, whatever the policy answers."
        in report
    )
    assert "whatever the policy answers" not in (tmp_path / "calm/report.md").read_text()
    stored = read_evaluation(tmp_path / "hands_high")
    assert stored.job().identity.trials == identify_trials("table_lift", SEED, 1, mishap="hands_high")
    with pytest.raises(
        ValueError, match=r"other max frames \(70 there, 210 here\), mishap \(none there, hands_high here\)"
    ):
        read_evaluation(tmp_path / "calm").require_trials(stored.job().identity.trials)


@pytest.mark.parametrize("task", TASKS)
def test_it_lasts_for_the_first_grasp_of_the_scene(task: str) -> None:
    """In the frames before, no hand closes and goes on closed; in the primitive that ends there, one does."""
    for seed in (SEED, SEED + 1):
        reference = ReferenceCache(task).get(seed)
        end = first_grasp_ends(reference)
        labels = reference.scripted
        assert labels[end] != labels[end - 1]
        begin = np.flatnonzero(labels[:end] != labels[end - 1])
        start = int(begin[-1]) + 1 if begin.size else 0
        opening = reference.state[:, [7, 15]].min(axis=1)
        assert opening[start] > 0.99
        assert opening[end] < 0.95
    never = replace(reference, state=np.ones_like(reference.state))
    assert first_grasp_ends(never) == 0


def test_episodes_do_not_know_of_each_other(policy: Path) -> None:
    worker = Worker(make_job("table_lift", str(policy), SEED, 2, mishap="hands_stay"))
    worker.play(SEED + 1)
    again = worker.play(SEED).trace
    worker.env.close()
    np.testing.assert_array_equal(again.state, play(policy, "hands_stay").state)


@pytest.mark.parametrize("task", TASKS)
def test_time_to_try_again(task: str) -> None:
    spoilt = identify_trials(task, 0, 1, mishap="hands_stay")
    assert spoilt.max_frames == get_task(f"{task}:level=hard").budget
    assert identify_trials(task, 0, 1).max_frames == get_task(task).budget


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mishap": "earthquake"}, "^mishap must be hands_stay, fingers_open, hands_high, got 'earthquake'$"),
        ({"mishap": "hands_stay", "push": "you/policy"}, "^--push is for results that LeRobot can make again"),
        ({"mishap": "hands_stay", "suite": "factors"}, "^mishap is an option of one evaluation, not of a suite"),
        ({"mishap": "hands_stay", "max_frames": 69}, "^max_frames must be at least 70"),
    ],
)
def test_refusals(policy: Path, tmp_path: Path, options: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        eval_command(EvalConfig(PolicySource(str(policy)), seed=SEED, output_dir=tmp_path / "eval", **options))
    assert listing(tmp_path) == {}
