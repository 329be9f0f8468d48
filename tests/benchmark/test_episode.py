"""One held-out episode, frame by frame: a policy's commands beside the expert's hands."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from hdril.benchmark.episode import EPISODE, main, play
from hdril.env import BimanualEnv
from hdril.evaluation.lerobot_actor import LeRobotActor
from hdril.tasks import get_task
from tests.evaluation.checkpoints import experts_episode, save_hdril, save_replay

SEED = 200_000


def test_an_expert_that_is_replayed_predicts_what_is_true(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expert = experts_episode(SEED)
    policy = save_replay(tmp_path / "policy", expert.action)
    arguments = [f"--policy={policy}", "--task=table_lift", f"--seed={SEED}", f"--output={tmp_path / 'out'}"]
    monkeypatch.setattr(sys, "argv", ["episode", *arguments])
    main()
    episode = json.loads((tmp_path / "out" / EPISODE).read_text())
    assert (episode["seed"], episode["success"], episode["attention"]) == (SEED, True, None)
    for side, first in (("left", 0), ("right", 8)):
        np.testing.assert_allclose(episode["predicted"][side], expert.action[:, first : first + 3], atol=6e-4)
        np.testing.assert_allclose(episode["true"][side], expert.state[1:, first : first + 3], atol=6e-4)
    monkeypatch.setattr(sys, "argv", ["episode", *arguments, "--policy.hidden=5"])
    with pytest.raises(ValueError, match=r"policy\.hidden"):
        main()


def test_a_mishap_is_played(tmp_path: Path) -> None:
    expert = experts_episode(SEED)
    policy = str(save_replay(tmp_path / "policy", expert.action))
    episode = play(policy, "table_lift", SEED, [], mishap="hands_high")
    assert not episode["success"]
    assert len(episode["predicted"]["left"]) == get_task("table_lift:level=hard").budget


@pytest.mark.parametrize(("preset", "part"), [("hdril", "dynamics"), ("linear", "planner")])
def test_attention_is_of_the_first_frame(dataset: Path, tmp_path: Path, preset: str, part: str) -> None:
    """Of the model of the primitive, or of the planner where that has no graph."""
    policy = save_hdril(tmp_path / "policy", dataset, preset=preset)
    told = play(str(policy), "table_lift", SEED, [], mishap="hands_stay")["attention"]
    assert told["nodes"] == ["left", "right", "table"]
    assert told["primitive"] in get_task("table_lift").labels
    assert told["of"] == part
    weights = np.array(told["weights"])
    assert weights.shape == (3, 3)
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=2e-3)
    actor, env = LeRobotActor(str(policy), get_task("table_lift")), BimanualEnv("table_lift")
    actor.act(env.reset(seed=SEED)[0])
    np.testing.assert_allclose(weights, getattr(actor.policy.attention(), part)[0].detach(), atol=6e-4)


def test_a_policy_that_fails_is_drawn_as_long_as_it_lasts(tmp_path: Path) -> None:
    expert = experts_episode(SEED)
    still = save_replay(tmp_path / "policy", expert.action[:1])
    episode = play(str(still), "table_lift", SEED, [], max_frames=len(expert.action) + 2)
    assert not episode["success"]
    assert len(episode["predicted"]["left"]) == len(expert.action) + 2
    assert len(episode["true"]["left"]) == len(expert.action)
