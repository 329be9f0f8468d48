"""One held-out episode, frame by frame: a policy's commands beside the expert's hands."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from hdril.benchmark.episode import EPISODE, main, play
from tests.evaluation.checkpoints import experts_episode, save_replay

SEED = 200_000


def test_an_expert_that_is_replayed_predicts_what_is_true(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expert = experts_episode(SEED)
    policy = save_replay(tmp_path / "policy", expert.action)
    arguments = [f"--policy={policy}", "--task=table_lift", f"--seed={SEED}", f"--output={tmp_path / 'out'}"]
    monkeypatch.setattr(sys, "argv", ["episode", *arguments])
    main()
    episode = json.loads((tmp_path / "out" / EPISODE).read_text())
    assert (episode["seed"], episode["success"]) == (SEED, True)
    for side, first in (("left", 0), ("right", 8)):
        np.testing.assert_allclose(episode["predicted"][side], expert.action[:, first : first + 3], atol=6e-4)
        np.testing.assert_allclose(episode["true"][side], expert.state[1:, first : first + 3], atol=6e-4)
    monkeypatch.setattr(sys, "argv", ["episode", *arguments, "--policy.hidden=5"])
    with pytest.raises(ValueError, match=r"policy\.hidden"):
        main()


def test_a_policy_that_fails_is_drawn_as_long_as_it_lasts(tmp_path: Path) -> None:
    expert = experts_episode(SEED)
    still = save_replay(tmp_path / "policy", expert.action[:1])
    episode = play(str(still), "table_lift", SEED, [], max_frames=len(expert.action) + 2)
    assert not episode["success"]
    assert len(episode["predicted"]["left"]) == len(expert.action) + 2
    assert len(episode["true"]["left"]) == len(expert.action)
