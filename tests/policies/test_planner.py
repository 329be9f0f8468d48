"""The planner: what it sees of a state, and what its training leaves out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy
from lerobot_policy_hdril.demonstrations import LATEST, History
from lerobot_policy_hdril.planner import Planner, begin_weights
from lerobot_policy_hdril.presets import PRESETS
from torch import Tensor
from torch.nn import functional as F

from tests.policies.tools import (
    BATCH,
    FRAMES,
    SMALL,
    STARTS,
    Training,
    assert_same,
    build,
    demonstrations,
    edit,
    observation,
    read,
    tensors,
)

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
    """Each position, and nothing else, as asinh(p / scale): 2 cm about the origin count ten times as much as 1 m from there."""
    planner, raw, normalised = make(scale=0.05), states(), states(1)
    seen = planner.seen(normalised, raw)
    torch.testing.assert_close(seen[..., : len(NAMES)], normalised)
    torch.testing.assert_close(seen[..., len(NAMES) :], (raw[..., POSITIONS] / 0.05).asinh())
    near, far = ((torch.tensor([at + 0.01, at - 0.01]) / 0.05).asinh().diff().abs() for at in (0.0, 1.0))
    assert near > 10.0 * far > 0.0


def test_the_second_scale_is_of_the_object_that_is_there() -> None:
    """Where nobody tells others anything, a cup that moves changes what is known of the cup alone."""
    planner, normalised = make(scale=0.05), states(1)[:, 0]
    for name, weight in planner.graph.named_parameters():
        if "message" in name:
            torch.nn.init.zeros_(weight)
    raw = states()[:, 0]
    elsewhere = raw.clone()
    elsewhere[:, NAMES.index("cup.x")] += 0.3

    def known(state: Tensor) -> Tensor:
        return planner.graph(planner.seen(normalised, state), state).reshape(3, 3, 8)

    differs = (known(elsewhere) - known(raw)).abs().amax((0, 2)) > 1e-4
    assert differs.tolist() == [False, False, True]


def test_attention_stays_between_hands_and_objects() -> None:
    planner, raw = make(scale=0.05), states()[:, 0]
    assert planner.graph.node_names == ["left", "right", "cup"]
    attention = planner.attention(raw, raw)
    torch.testing.assert_close(attention.sum(-1), torch.ones(3, 3))
    assert (attention - planner.attention(raw, moved(raw, 0.2))).abs().max() > 1e-6


def test_what_is_left_out_is_the_same_at_all_frames_of_an_episode_and_differs_between_episodes() -> None:
    planner, raw = make(dropout=0.5), states()[:1, :1].expand(3, 5, -1)

    def generator() -> torch.Generator:
        return torch.Generator().manual_seed(3)

    together, _ = planner(raw, raw, None, *OVER, generator())
    memory = None
    for frame in range(5):
        playing, elapsed = (each[:, frame : frame + 1] for each in OVER)
        alone, memory = planner(raw[:, :1], raw[:, :1], memory, playing, elapsed, generator())
        torch.testing.assert_close(alone[:, 0], together[:, frame])
    assert (together[0] - together[1]).abs().max() > 1e-4
    whole = planner(raw, raw, None, *OVER)[0]
    torch.testing.assert_close(whole[0], whole[1])


def test_a_share_of_the_hidden_states_is_left_out_and_the_rest_makes_up_for_it() -> None:
    planner, count = make(dropout=0.3), 4000
    torch.nn.init.zeros_(planner.gru.weight_ih_l0)  # so that what is left out before the memory has no effect
    raw = states()[:1, :1].expand(count, 1, -1)
    told = torch.zeros(count, 1, dtype=torch.long), torch.zeros(count, 1, dtype=torch.long)
    passes_on = torch.nn.Linear(16 + 3 + 7, 16, bias=False)  # what it sees of the memory
    with torch.no_grad():
        passes_on.weight.copy_(torch.eye(16, 26))
    planner.head = torch.nn.Sequential(passes_on)
    whole = planner(raw, raw, None, *told)[0][0, 0]
    some = planner(raw, raw, None, *told, torch.Generator().manual_seed(0))[0][:, 0]
    dropped = some == 0.0
    assert abs(dropped.float().mean() - 0.3) < 0.01
    torch.testing.assert_close(torch.where(dropped, whole, some * 0.7), whole.expand(count, -1))


def test_some_of_the_embedded_states_are_left_out() -> None:
    """So the memory differs."""
    planner, raw = make(dropout=0.3), states()
    _, whole = planner(raw, raw, None, *OVER)
    _, some = planner(raw, raw, None, *OVER, torch.Generator().manual_seed(0))
    assert (whole - some).abs().max() > 1e-3


def test_the_planner_leaves_something_out_of_episodes_and_of_single_frames(metadata, monkeypatch) -> None:
    policy = build(metadata, preset="hdril_reactive", hidden_dim=32)
    lengths, forward = [], policy.planner.forward

    def watched(normalised, raw, memory=None, playing=None, elapsed=None, generator=None):
        lengths.append(normalised.shape[1] if generator is not None else None)
        return forward(normalised, raw, memory, playing, elapsed, generator)

    monkeypatch.setattr(policy.planner, "forward", watched)
    policy.train().forward({"index": BATCH})
    policy.eval().forward({"index": BATCH})
    assert lengths == [FRAMES, 1, None, None]


def test_a_later_primitive_that_looks_like_the_first_does_not_begin_an_episode(copy: Path) -> None:
    """A hand comes back to where it was: what plays there is not what begins there. Here all frames of an episode look alike."""
    for key in ("observation.state", "observation.environment_state"):
        first: dict[int, Any] = {}
        edit(copy, key, lambda episode, frame, value, first=first: first.setdefault(episode, value))
    metadata = read(copy)
    policy = build(metadata, preset="hdril_reactive", hidden_dim=32)
    training = Training(policy)
    for _ in range(100):
        training.step(BATCH)
    state = policy.eval()._state(observation(metadata, [FRAMES * episode for episode in range(6)]))
    assert policy.choose(state, None).begin[:, 0].min() > 0.5


def test_single_frames_are_told_whether_they_are_of_a_first_primitive(metadata, monkeypatch) -> None:
    """If not, it is told of them what it is told of no frame of an episode. Other policies may be asked about any frame alone."""
    rows = torch.tensor([0, 9, 10, 69])
    fused = build(metadata, preset="hdril_reactive", hidden_dim=32)
    other = build(metadata, preset="hdril", replan_every=1, termination="learned", hidden_dim=32)
    later = fused.planner.steps
    for policy, expected in ((fused, [0, 0, later, later]), (other, [0, 0, 0, 0])):
        calls, forward = [], policy.planner.forward

        def watched(normalised, raw, memory=None, *told, forward=forward, calls=calls):
            found = forward(normalised, raw, memory, *told)
            calls.append((found[0], *told))
            return found

        monkeypatch.setattr(policy.planner, "forward", watched)
        loss = policy.eval().forward({"index": rows})[1]["planner_loss"]
        (whole, *_), (alone, playing, elapsed, _) = calls
        assert playing[:, 0].tolist() == [len(policy.config.forms)] * 4, "that nothing plays"
        assert elapsed[:, 0].tolist() == expected
        history = demonstrations(policy).history(rows)
        begins = torch.where(history.begins, history.primitive + 1, 0)
        labels = demonstrations(policy).label[rows] + 1
        both = F.cross_entropy(whole.flatten(0, 1), begins.flatten()) + F.cross_entropy(alone[:, 0], labels)
        assert loss == pytest.approx(both.item(), abs=1e-5), "single frames count as much as episodes"


def test_the_papers_models_and_once_a_primitive_have_the_plain_planner() -> None:
    options = (
        "planner_balance",
        "planner_dropout",
        "planner_late",
        "planner_scale",
        "least_survival",
        "repeat_discount",
    )
    other = {name for name, values in PRESETS.items() if any(values[option] for option in options)}
    assert other == {"hdril_reactive", "network_reactive"}


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


@pytest.fixture
def mended(copy: Path) -> LeRobotDatasetMetadata:
    """In two of the six episodes the last primitive is broken off, and the third begins once more; in one of them, again."""
    again = {2: [62], 4: [62, 66]}
    edit(
        copy, "subtask_index", lambda episode, frame, label: 2 if frame >= min(again.get(episode, [FRAMES])) else label
    )
    edit(copy, "subtask_start", lambda episode, frame, value: frame in STARTS or frame in again.get(episode, []))
    return read(copy)


def test_beginnings_are_counted_by_what_was_before(mended) -> None:
    data = demonstrations(build(mended, preset="hdril_reactive", hidden_dim=32))
    usual = torch.zeros(7, 6, dtype=torch.long)
    usual[6, 0] = usual[0, 1] = usual[1, 2] = usual[2, 3] = usual[3, 4] = usual[4, 5] = 1
    after, again = torch.zeros_like(usual), torch.zeros_like(usual)
    after[5, 2], again[2, 2] = 1, 1
    assert torch.equal(data.beginnings(torch.ones(6, dtype=torch.bool)), 6 * usual + 2 * after + again)
    assert torch.equal(data.beginnings(torch.arange(6) == 4), usual + after + again)
    assert torch.equal(data.beginnings(torch.arange(6) < 2), 2 * usual)


def test_rare_beginnings_count_more_and_no_more_than_ten_times() -> None:
    counts = torch.tensor([[400, 100], [4, 0], [1, 400]])
    torch.testing.assert_close(begin_weights(counts, 0.5), torch.tensor([[1.0, 2.0], [10.0, 10.0], [10.0, 1.0]]))
    torch.testing.assert_close(begin_weights(counts, 0.25)[1:, 0], torch.tensor([100.0, 400.0]) ** 0.25)
    assert torch.equal(begin_weights(counts, 0.0), torch.ones(3, 2))


def test_the_loss_of_a_beginning_is_weighted_and_that_of_all_else_is_not(mended) -> None:
    plain, policy = (
        build(mended, preset="hdril_reactive", hidden_dim=32, planner_balance=balance) for balance in (0.0, 1.0)
    )
    assert_same(tensors(plain), tensors(policy))
    data, rows = demonstrations(policy), torch.tensor([2 * FRAMES, 4 * FRAMES])
    history, window = data.history(rows), data.window(rows, 2, 2)
    told, _ = policy.planner(policy.normalise(history.state), history.state, None, history.playing, history.elapsed)
    right = torch.where(history.begins, history.primitive + 1, 0)
    each = torch.nn.functional.cross_entropy(told[history.mask], right[history.mask], reduction="none")
    more = torch.zeros_like(history.elapsed, dtype=torch.float32)
    more[:, 62], more[1, 66] = 6 / 2 - 1, 6 / 1 - 1  # six episodes begin as usual, two thus, and one again
    difference = policy.planner_loss(history, window)[0] - plain.planner_loss(history, window)[0]
    torch.testing.assert_close(difference, (each * more[history.mask]).mean())


def test_beginnings_of_episodes_that_are_not_learned_from_do_not_count(mended) -> None:
    policy = build(mended, learned=False, preset="hdril_reactive", hidden_dim=32, planner_balance=0.5)
    data, learned = demonstrations(policy), torch.zeros(6, dtype=torch.bool)
    for episodes in ([0, 1, 4], [2]):
        learned[episodes] = True
        policy.forward({"index": FRAMES * torch.tensor(episodes)})
        told = policy._begin_weights
        assert told is not None
        assert torch.equal(told, begin_weights(data.beginnings(learned), 0.5))
        assert not torch.equal(told, begin_weights(data.beginnings(torch.ones(6, dtype=torch.bool)), 0.5))


def test_held_out_losses_are_not_weighted(mended) -> None:
    plain, policy = (
        build(mended, preset="hdril_reactive", hidden_dim=32, planner_balance=balance).eval() for balance in (0.0, 1.0)
    )
    with torch.no_grad():
        losses = [p.forward({"index": BATCH})[1]["planner_loss"] for p in (plain, policy)]
    assert losses[0] == losses[1]


def test_a_resumed_policy_weighs_beginnings_as_before(mended, tmp_path: Path) -> None:
    policy = build(mended, preset="hdril_reactive", hidden_dim=32, planner_dropout=0.0)
    policy.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    resumed = make_policy(config, ds_meta=mended)
    losses = [float(p.train().forward({"index": BATCH})[1]["planner_loss"]) for p in (policy, resumed)]
    assert losses[0] == losses[1]


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (
            {"planner_balance": 1.1},
            r"^policy\.planner_balance must be from 0 to 1, and is for .*; got 1\.1 and learned$",
        ),
        ({"planner_balance": -0.1}, r"^policy\.planner_balance must be from 0 to 1"),
        ({"planner_balance": 0.5, "termination": "length"}, r"policy\.termination=learned; got 0\.5 and length$"),
        ({"planner_late": 1.1}, r"^policy\.planner_late must be from 0 to 1, and is for .*; got 1\.1 and learned$"),
        ({"planner_late": -0.1}, r"^policy\.planner_late must be from 0 to 1"),
        ({"planner_late": 0.5, "termination": "length"}, r"policy\.termination=learned; got 0\.5 and length$"),
        ({"planner_dropout": 1.0}, r"^policy\.planner_dropout must be from 0 to less than 1, got 1\.0$"),
        ({"planner_dropout": -0.1}, r"^policy\.planner_dropout must be from 0 to less than 1"),
        ({"planner_scale": -0.05}, r"^policy\.planner_scale must be 0 or a length in m"),
        ({"planner_scale": float("nan")}, r"^policy\.planner_scale must be 0 or a length in m"),
        (
            {"planner_scale": 0.05, "interaction": "scalar"},
            r"is for policy\.interaction=object; got 0\.05 and scalar$",
        ),
    ],
)
def test_options_of_the_planner_that_make_no_sense_are_refused(values: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        HDRILConfig(**SMALL | values)


def test_only_a_planner_that_ends_primitives_is_told_of_beginnings_late() -> None:
    assert HDRILConfig(push_to_hub=False, device="cpu").planner_late == 0.5
    assert HDRILConfig(push_to_hub=False, device="cpu", termination="length").planner_late == 0.0


def made_up_history(seed: int) -> History:
    """Four episodes of up to 60 frames with runs of 1 to 12 frames, padded by what may be anything."""
    rng = torch.Generator().manual_seed(seed)
    label, begins = torch.zeros(4, 60, dtype=torch.long), torch.zeros(4, 60, dtype=torch.bool)
    playing, elapsed = torch.full((4, 60), 5), torch.zeros(4, 60, dtype=torch.long)
    for row in range(4):
        frame = 0
        while frame < 60:
            end = min(60, frame + int(torch.randint(1, 13, (), generator=rng)))
            label[row, frame:end] = int(torch.randint(0, 5, (), generator=rng))
            begins[row, frame] = True
            playing[row, frame + 1 : end + 1] = label[row, frame]
            elapsed[row, frame + 1 : end + 1] = torch.arange(1, len(elapsed[row, frame + 1 : end + 1]) + 1)
            frame = end
    mask = torch.arange(60) < torch.tensor([60, 41, 30, 1])[:, None]
    return History(torch.zeros(4, 60, 2), label, begins, playing, elapsed, mask)


@pytest.mark.parametrize("seed", range(5))
def test_a_late_player_goes_on_until_it_begins_and_counts_from_there(seed: int) -> None:
    history = made_up_history(seed)
    late = history.late(1.0, torch.Generator().manual_seed(seed))
    assert torch.equal(late.state, history.state)
    assert torch.equal(late.primitive, history.primitive), "what is right stays"
    assert not (history.begins & ~late.begins).any()
    for row in range(4):
        frames = int(history.mask[row].sum())
        starts = [t for t in range(frames) if history.begins[row, t]]
        assert (int(late.playing[row, 0]), int(late.elapsed[row, 0])) == (5, 0)
        for start, end in zip(starts, [*starts[1:], frames], strict=True):
            asked = [t for t in range(start, end) if late.begins[row, t]]
            delay = asked[-1] - start
            assert asked == list(range(start, start + delay + 1)), "it is asked until it begins"
            longest = min(LATEST, end - start - 1) if start else 0
            assert (1 <= delay <= longest) if longest else delay == 0
            for t in range(start, end):
                told = int(late.playing[row, t]), int(late.elapsed[row, t])
                if t <= asked[-1]:
                    before = int(late.playing[row, start]), int(late.elapsed[row, start]) + t - start
                    assert told == before, "what played before goes on"
                else:
                    assert told == (int(history.primitive[row, start]), t - asked[-1])
            if end < frames:
                told = int(late.playing[row, end]), int(late.elapsed[row, end])
                assert told == (int(history.primitive[row, start]), end - asked[-1])


def test_delays_are_drawn_for_each_beginning_from_one_to_six_frames() -> None:
    delays, both = [], []
    for seed in range(40):
        history = made_up_history(seed)
        late = history.late(0.5, torch.Generator().manual_seed(seed))
        starts = [t for t in range(1, 60) if history.begins[0, t]]
        found = []
        for start, end in zip(starts, [*starts[1:], 60], strict=True):
            if end - start > 7:
                found.append(int(late.begins[0, start:end].sum()) - 1)
        delays += found
        both.append(0 in found and any(found))
    assert set(delays) == set(range(7))
    assert sum(both) > 5, "within an episode, too"


def test_nobody_is_late_unless_asked() -> None:
    history = made_up_history(0)
    same = history.late(0.0, torch.Generator())
    for name in ("playing", "elapsed", "begins"):
        assert torch.equal(getattr(same, name)[history.mask], getattr(history, name)[history.mask])
    some = history.late(0.3, torch.Generator().manual_seed(1)).begins.sum() - history.begins.sum()
    every = history.late(1.0, torch.Generator().manual_seed(1)).begins.sum() - history.begins.sum()
    assert 0 < some < 0.6 * every


def test_the_planner_learns_what_to_answer_when_it_is_late(mended) -> None:
    policy = build(mended, preset="hdril_reactive", hidden_dim=32, planner_dropout=0.0, planner_late=1.0)
    data, rows = demonstrations(policy), torch.tensor([2 * FRAMES, 4 * FRAMES])
    history, window = data.history(rows), data.window(rows, 2, 2)
    loss, _ = policy.planner_loss(history, window, torch.Generator().manual_seed(3))
    late = history.late(1.0, torch.Generator().manual_seed(3))
    assert torch.equal(policy.planner_loss(late, window)[0], loss)
    assert not torch.equal(policy.planner_loss(history, window)[0], loss)


def test_being_late_is_for_training_and_decided_by_the_batch(metadata) -> None:
    options = {"preset": "hdril_reactive", "hidden_dim": 32, "planner_dropout": 0.0, "hand_noise": 0.0}
    late, prompt = (build(metadata, planner_late=share, **options) for share in (1.0, 0.0))
    prompt.load_state_dict(late.state_dict())

    def losses(training: bool) -> list[float]:
        with torch.no_grad():
            return [p.train(training).forward({"index": BATCH})[1]["planner_loss"] for p in (late, late, prompt)]

    first, again, without = losses(training=True)
    assert first == again != without
    assert len(set(losses(training=False))) == 1


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
