"""Primitives of several forms: models of their own, and one primitive to everybody else."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy
from lerobot_policy_hdril.forms import FEWEST, assign, find_forms, halves
from lerobot_policy_hdril.player import PlaybackState
from lerobot_policy_hdril.presets import PRESETS

from tests.policies.test_checkpoint import load
from tests.policies.tools import FRAMES, SMALL, STARTS, build, demonstrations, edit, observation, read

LEFT, RIGHT = 7, 15
"""Columns of an action: how far the hands are told to open."""


def test_numbers_are_halved_in_the_middle_of_their_range() -> None:
    action = np.array([[0.0, 5.0, 2.0], [1.0, 9.0, 2.0]], np.float32)
    first = np.array([[0.4, 7.5, 2.0], [0.6, 6.5, 2.0]], np.float32)
    assert halves(first, action).tolist() == [[0, 1, 0], [1, 0, 0]]


def test_forms_are_what_enough_executions_begin_with_the_most_frequent_first() -> None:
    label = np.array([1] * 20 + [0] * 4)
    half = np.array([[0, 1]] * FEWEST + [[1, 1]] * (16 - FEWEST) + [[1, 0]] * 4 + [[0, 0]] * 4)
    forms = find_forms(label, half, 2)
    assert forms == [(0, 0, 0), (1, 1, 1), (1, 0, 1)]
    expected = [2] * FEWEST + [1] * (20 - FEWEST) + [0] * 4
    assert assign(label, half, forms).tolist() == expected
    assert assign(label, half[:, :0], find_forms(label, half[:, :0], 2)).tolist() == label.tolist()


@pytest.fixture
def gripping(copy: Path) -> LeRobotDatasetMetadata:
    """The first primitive is begun again at its fifth frame, now with the left hand closed. Both hands are open else."""

    def change(episode: int, frame: int, action: list[float]) -> list[float]:
        action = list(action)
        action[LEFT], action[RIGHT] = float(not 5 <= frame < 10), 1.0
        return action

    edit(copy, "action", change)
    edit(copy, "subtask_start", lambda episode, frame, value: frame in (*STARTS, 5))
    return read(copy)


def make(metadata: LeRobotDatasetMetadata, **values: Any) -> HDRILPolicy:
    return build(metadata, preset="hdril_reactive", **{"hidden_dim": 32} | values).eval()


def test_a_form_has_a_model_and_is_no_other_primitive(gripping) -> None:
    policy = make(gripping)
    names = policy.config.primitives
    # As frequent forms are in the order of their numbers. The right hand's number never varies.
    assert policy.config.forms == [[0, 0, 0], [0, 1, 0], *([k, 1, 0] for k in range(1, 6))]
    assert policy.config.form_names == [names[0], *names]
    assert len(policy.fused) == len(policy.config.primitive_lengths) == 7
    seen = observation(gripping, [5])
    state = torch.cat([seen["observation.state"], seen["observation.environment_state"]], dim=-1)
    state = state[:, None].expand(-1, 1 + len(policy.config.filters), -1)
    told = [policy.plan(state, torch.tensor([k]), torch.tensor([0]))[0, 0, LEFT] for k in (0, 1)]
    assert float(told[0]) == pytest.approx(0.0, abs=0.1)
    assert float(told[1]) == pytest.approx(1.0, abs=0.1)
    policy.reset()
    for frame in range(12):
        policy.select_action(observation(gripping, [frame]))
        explained = policy.explain()
        assert explained is not None
        assert list(explained.probabilities) == names
        assert sum(explained.probabilities.values()) == pytest.approx(1.0, abs=1e-5)
        assert explained.primitive in names


def test_forms_of_a_primitive_are_alike_and_told_as_one(gripping) -> None:
    policy = make(gripping)
    forms = policy.config.form_names
    assert policy.alike.tolist() == [[one == other for other in forms] for one in forms]
    assert "alike" in dict(policy.named_buffers()), "it moves to the device with the weights"
    assert "alike" not in policy.state_dict(), "checkpoints of before have none"
    policy.select_action(observation(gripping, [0]))
    playback = policy._playback
    assert isinstance(playback, PlaybackState)
    assert playback.begun[0].tolist() == policy.alike[playback.primitive[0]].long().tolist()
    again, given_up, passed_over = "grasp tried again", "grasp given up", "grasp passed over"
    # By the form that begins, the one that was given up, and the one that was passed over.
    expected = {
        (1, -1, -1): (again,),
        (2, -1, -1): (),
        (2, 0, -1): (given_up,),
        (1, 0, -1): (again,),
        (2, -1, 1): (passed_over,),
        (0, -1, 1): (again,),
        (0, -1, 2): ("move passed over", again),
    }
    assert forms[:3] == ["grasp", "grasp", "move"]
    for (form, gave_up, passed_over), events in expected.items():
        told = {"primitive": form, "elapsed": 0, "gave_up": gave_up, "passed_over": passed_over}
        begun = torch.zeros_like(playback.begun)
        begun[0, :3] = torch.tensor([2, 2, 1])
        policy._playback = replace(
            playback, begun=begun, **{name: torch.tensor([value]) for name, value in told.items()}
        )
        explained = policy.explain()
        assert explained is not None
        assert explained.events == events
    policy._playback = replace(policy._playback, elapsed=torch.tensor([1]), passed_over=torch.tensor([-1]))
    explained = policy.explain()
    assert explained is not None
    assert explained.events == ()


def test_each_episode_of_a_batch_tells_its_own_events(gripping) -> None:
    policy = make(gripping)
    policy.select_action(observation(gripping, [0, 1]))
    playback = policy._playback
    assert isinstance(playback, PlaybackState)
    begun = torch.zeros_like(playback.begun)
    begun[0] = 1
    begun[1] = 2
    told = {"primitive": [0, 2], "gave_up": [2, -1], "passed_over": [-1, 0], "elapsed": [0, 0]}
    policy._playback = replace(playback, begun=begun, **{name: torch.tensor(value) for name, value in told.items()})
    explained = [policy.explain(row) for row in range(2)]
    assert all(explained)
    assert [one.events for one in explained if one] == [
        ("move given up",),
        ("grasp passed over", "move tried again"),
    ]


def test_a_checkpoint_keeps_its_forms_whatever_it_learns_from_next(gripping, metadata, tmp_path: Path) -> None:
    policy = make(gripping)
    policy.save_pretrained(tmp_path)
    assert load(tmp_path).config.forms == policy.config.forms
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    tuned = make_policy(config, ds_meta=metadata)
    assert isinstance(tuned, HDRILPolicy)
    assert tuned.config.forms == policy.config.forms
    assert int(demonstrations(tuned).label.max()) == 6


def test_a_form_that_few_episodes_show_moves_as_the_primitive_does_in_general(gripping) -> None:
    for episodes, shared in ((range(FEWEST - 1), True), (range(FEWEST), False)):
        policy = build(gripping, learned=False, preset="hdril_reactive", hidden_dim=32)
        data = demonstrations(policy)
        policy.forward({"index": torch.tensor([FRAMES * episode for episode in episodes])})
        assert torch.equal(policy.fused[0].weight, policy.fused[1].weight) == shared
    assert data.beginnings(torch.ones(6, dtype=torch.bool)).sum(0).tolist() == [6] * 7


def test_damage_on_purpose_is_done_to_all_forms(gripping, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``scripts/damage.py``"""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "scripts")
    policy = make(gripping)
    policy.save_pretrained(tmp_path / "whole")
    import_module("damage").damage(tmp_path / "whole", tmp_path / "damaged", policy.config.primitives[0])
    damaged = load(tmp_path / "damaged")
    assert [bool((maps.weight == 0.0).all()) for maps in damaged.fused] == [True, True, *[False] * 5]


def test_the_card_tells_forms_apart(gripping) -> None:
    card = str(make(gripping).generate_model_card("user/data", "hdril", None, None))
    first = demonstrations(make(gripping)).primitives[0]
    for upper in ("no number", "left_gripper.pos"):
        assert re.search(rf"\| {first} \(begins with {upper} in the upper half\) +\| 5 +\|", card)


def test_without_the_option_each_primitive_has_one_form(gripping, metadata) -> None:
    assert make(gripping, split_forms=False).config.forms == [[k] for k in range(6)]
    assert build(metadata).config.forms == [[k] for k in range(6)]
    split = {name for name, values in PRESETS.items() if values["split_forms"]}
    assert split == {"hdril_reactive", "network_reactive"}
    with pytest.raises(
        ValueError, match=r"^policy\.split_forms is for policy\.coordinates=fused; got true and absolute$"
    ):
        HDRILConfig(**SMALL, coordinates="absolute", split_forms=True)
