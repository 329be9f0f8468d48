"""The planner: what it sees of a state, and what its training leaves out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy
from lerobot_policy_hdril.planner import Planner
from torch import Tensor

from tests.policies.tools import BATCH, SMALL, build

AXES = ("x", "y", "z", "qx", "qy", "qz", "qw")
NAMES = [f"{node}.{axis}" for node in ("left_ee", "right_ee", "cup") for axis in AXES] + ["cup.size"]
POSITIONS = [i for i, name in enumerate(NAMES) if name[-2:] in (".x", ".y", ".z")]
OVER = torch.tensor([[2] * 5] * 3), torch.tensor([list(range(5))] * 3)
"""What plays at five frames of three episodes, and since when."""


def make(**values: Any) -> Planner:
    torch.manual_seed(0)
    return Planner(NAMES, 2, "object", hidden_dim=16, node_dim=8, steps=6, **values)


def states(seed: int = 0) -> Tensor:
    """(3, 5, S)"""
    return torch.randn(3, 5, len(NAMES), generator=torch.Generator().manual_seed(seed))


def moved(raw: Tensor, far: float) -> Tensor:
    """All that has a pose, ``far`` metres to the left: it is where it was for all others."""
    raw = raw.clone()
    raw[..., POSITIONS[1::3]] += far
    return raw


def test_with_a_scale_the_planner_sees_where_things_are_beside_what_is_normalised() -> None:
    raw, normalised = states(), states(1)
    blind, sees = make(), make(scale=0.05)
    torch.testing.assert_close(
        blind(normalised, moved(raw, 0.1), None, *OVER)[0], blind(normalised, raw, None, *OVER)[0]
    )
    assert (
        sees(normalised, moved(raw, 0.1), None, *OVER)[0] - sees(normalised, raw, None, *OVER)[0]
    ).abs().max() > 1e-3


def test_the_second_scale_tells_centimetres_at_the_middle_from_far_away() -> None:
    """A difference of 2 cm about the origin counts ten times as much as 1 m from there, and as much as asinh says."""
    planner = make(scale=0.05)
    raw = states() * torch.tensor([0.0 if i in POSITIONS else 1.0 for i in range(len(NAMES))])
    normalised = torch.zeros_like(raw)

    def embedded(far: float) -> Tensor:
        return planner.graph(*(each.flatten(0, 1) for each in (planner.seen(normalised, moved(raw, far)), raw)))

    def seen(far: float) -> Tensor:
        return planner.seen(normalised, moved(raw, far))[0, 0, len(NAMES) :].unique()

    torch.testing.assert_close(seen(0.01), torch.tensor([0.0, 0.01 / 0.05]).asinh())
    torch.testing.assert_close(seen(-1.0), torch.tensor([-1.0 / 0.05, 0.0]).asinh())
    near, far = (embedded(at + 0.01) - embedded(at - 0.01) for at in (0.0, 1.0))
    assert near.norm() > 10.0 * far.norm() > 0.0


def test_attention_stays_between_hands_and_objects() -> None:
    planner, raw = make(scale=0.05), states()[:, 0]
    assert planner.graph.node_names == ["left", "right", "cup"]
    attention = planner.attention(raw, raw)
    torch.testing.assert_close(attention.sum(-1), torch.ones(3, 3))
    assert (attention - planner.attention(raw, moved(raw, 0.2))).abs().max() > 1e-6


def test_what_is_left_out_is_the_same_at_all_frames_of_an_episode_and_differs_between_episodes() -> None:
    planner, raw = make(dropout=0.5), states()[:1, :1].expand(3, 5, -1)

    def noise() -> torch.Generator:
        return torch.Generator().manual_seed(3)

    together, _ = planner(raw, raw, None, *OVER, noise())
    memory = None
    for frame in range(5):
        playing, elapsed = (each[:, frame : frame + 1] for each in OVER)
        alone, memory = planner(raw[:, :1], raw[:, :1], memory, playing, elapsed, noise())
        torch.testing.assert_close(alone[:, 0], together[:, frame])
    assert (together[0] - together[1]).abs().max() > 1e-4
    whole = planner(raw, raw, None, *OVER)[0]
    torch.testing.assert_close(whole[0], whole[1])


def test_the_rest_makes_up_for_what_is_left_out() -> None:
    """Of many draws, the mean of what a linear head says is what it says without, where the memory sees nothing."""
    planner, count = make(dropout=0.3), 4000
    planner.head = torch.nn.Sequential(torch.nn.Linear(16 + 3 + 7, 3))
    torch.nn.init.zeros_(planner.gru.weight_ih_l0)
    raw = states()[:1, :1].expand(count, 1, -1)
    told = torch.zeros(count, 1, dtype=torch.long), torch.zeros(count, 1, dtype=torch.long)
    logits = planner(raw, raw, None, *told, torch.Generator().manual_seed(0))[0][:, 0]
    without = planner(raw, raw, None, *told)[0][0, 0]
    deviation = logits.std(0) / count**0.5
    assert ((logits.mean(0) - without).abs() < 5.0 * deviation).all()
    assert logits.std(0).min() > 0.001


def test_dropout_is_for_training_and_decided_by_the_batch(metadata) -> None:
    policy = build(metadata, preset="hdril", planner_dropout=0.5, hidden_dim=32)
    quiet = build(metadata, preset="hdril", hidden_dim=32)
    quiet.load_state_dict(policy.state_dict())

    def losses(training: bool) -> list[float]:
        with torch.no_grad():
            return [p.train(training).forward({"index": BATCH})[1]["planner_loss"] for p in (policy, policy, quiet)]

    dropped, again, without = losses(training=True)
    assert dropped == again != without
    assert losses(training=False) == [without] * 3


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"planner_dropout": 1.0}, r"^policy\.planner_dropout must be from 0 to less than 1, got 1\.0$"),
        ({"planner_dropout": -0.1}, r"^policy\.planner_dropout must be from 0 to less than 1"),
        ({"planner_scale": -0.05}, r"^policy\.planner_scale must not be negative"),
        (
            {"planner_scale": 0.05, "interaction": "scalar"},
            r"is for policy\.interaction=object; got 0\.05 and scalar$",
        ),
    ],
)
def test_options_of_the_planner_that_make_no_sense_are_refused(values: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        HDRILConfig(**SMALL | values)


def test_other_graphs_have_no_second_scale_unless_it_is_asked_for() -> None:
    assert HDRILConfig(push_to_hub=False, device="cpu").planner_scale == 0.05
    assert HDRILConfig(push_to_hub=False, device="cpu", interaction="scalar").planner_scale == 0.0


def test_dropout_of_a_checkpoint_may_change_and_the_scale_may_not(metadata, tmp_path: Path) -> None:
    build(metadata, preset="hdril_reactive", hidden_dim=32).save_pretrained(tmp_path)

    def load(*overrides: str) -> HDRILPolicy:
        config = HDRILConfig.from_pretrained(tmp_path, cli_overrides=list(overrides))
        return HDRILPolicy.from_pretrained(tmp_path, config=config)

    assert load("--planner_dropout=0.1").planner.dropout == 0.1
    with pytest.raises(ValueError, match=r"policy\.planner_scale is 0\.05 in the checkpoint .*; got 0\.1"):
        load("--planner_scale=0.1")
