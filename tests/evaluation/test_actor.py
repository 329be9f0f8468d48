"""A LeRobot policy as an actor: what it does, and what it tells of itself in the task's labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hdril.evaluation.checkpoint import find_checkpoint
from hdril.evaluation.lerobot_actor import LeRobotActor, foreign_primitives
from hdril.tasks import get_task
from tests.evaluation.checkpoints import save_act, save_hdril, save_replay

TASK = get_task("table_lift")
SEEN = {"agent_pos": np.zeros(16, np.float32), "environment_state": np.zeros(7, np.float32)}
ACTIONS = np.arange(64, dtype=np.float32).reshape(4, 16)


def actor_of(folder: Path, **config: Any) -> LeRobotActor:
    actor = LeRobotActor(str(save_replay(folder, ACTIONS, **config)), TASK)
    actor.reset(0)
    return actor


def test_actions_are_the_policys(tmp_path: Path) -> None:
    actor = actor_of(tmp_path / "p")
    for row in ACTIONS:
        decision = actor.act(SEEN)
        np.testing.assert_array_equal(decision.action, row)
        assert decision.explanation is None, "no primitives"
    actor.reset(0)
    np.testing.assert_array_equal(actor.act(SEEN).action, ACTIONS[0])


def test_explanations_are_in_the_tasks_labels(tmp_path: Path) -> None:
    """The policy counts its primitives in another order than the task does."""
    actor = actor_of(tmp_path / "p", primitives=["lift", "grasp"], labels=[1, 1, 0, 0])
    grasp, lift = TASK.labels.index("grasp"), TASK.labels.index("lift")
    told = [actor.act(SEEN).explanation for _ in range(4)]
    assert [e.primitive for e in told if e] == [grasp, grasp, lift, lift]
    assert [int(e.probabilities.argmax()) for e in told if e] == [grasp, grasp, lift, lift]
    assert all(e.probabilities.shape == (len(TASK.labels),) and e.probabilities.sum() == 1.0 for e in told if e)
    first, second, third, _ = told
    assert first
    assert second
    assert third
    np.testing.assert_array_equal(first.plan, ACTIONS[:2])
    assert second.plan is None
    np.testing.assert_array_equal(third.plan, ACTIONS[2:])
    assert first.attention == {"left": 0.25, "table": 0.75}
    assert foreign_primitives(find_checkpoint(str(tmp_path / "p")), TASK) == ()


def test_primitives_that_are_not_the_tasks_are_no_label(tmp_path: Path) -> None:
    actor = actor_of(tmp_path / "p", primitives=["juggle", "lift"], labels=[0, 0, 1, 1])
    juggling, _, lifting, _ = (actor.act(SEEN).explanation for _ in range(4))
    assert juggling
    assert lifting
    assert juggling.primitive == -1
    assert juggling.probabilities.sum() == 0.0, "not label 0, nor any other"
    assert lifting.primitive == TASK.labels.index("lift")
    assert foreign_primitives(find_checkpoint(str(tmp_path / "p")), TASK) == ("juggle",)


@pytest.mark.portable
def test_hdril_explains_itself(dataset: Path, tmp_path: Path) -> None:
    actor = LeRobotActor(str(save_hdril(tmp_path / "p", dataset)), TASK)
    actor.reset(0)
    told = actor.act(SEEN).explanation
    assert told is not None
    assert told.probabilities.sum() == pytest.approx(1.0, abs=1e-5)
    assert told.primitive in range(len(TASK.labels))
    assert told.plan is not None
    assert told.plan.shape[1] == 16
    assert set(told.attention or {}) == {"left", "right", "table"}
    following = actor.act(SEEN).explanation
    assert following is not None
    assert following.plan is None


def test_a_policy_that_explains_nothing(dataset: Path, tmp_path: Path) -> None:
    actor = LeRobotActor(str(save_act(tmp_path / "p", dataset, None)), TASK)
    actor.reset(0)
    decision = actor.act(SEEN)
    assert decision.explanation is None
    assert decision.action.shape == (16,)
    assert decision.action.dtype == np.float32
