"""Primitives of several forms: models of their own, and one primitive to everybody else."""

from __future__ import annotations

import re
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


def test_a_primitive_that_begins_again_in_another_form_was_tried_again(gripping) -> None:
    policy = make(gripping)
    policy.select_action(observation(gripping, [0]))
    playback = policy._playback
    assert isinstance(playback, PlaybackState)
    expected = {
        (1, -1): ("grasp tried again",),
        (2, -1): (),
        (2, 0): ("grasp given up",),
        (1, 0): ("grasp tried again",),
    }
    for (form, gave_up), again in expected.items():
        begun = torch.zeros_like(playback.begun)
        begun[0, 0] = begun[0, form] = 1
        begun[0, 0] += form == 0
        policy._playback = PlaybackState(
            **vars(playback)
            | {"primitive": torch.tensor([form]), "elapsed": torch.tensor([0]), "begun": begun}
            | {"gave_up": torch.tensor([gave_up])}
        )
        explained = policy.explain()
        assert explained is not None
        assert explained.events == again


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
