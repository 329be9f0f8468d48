"""A policy that decides at every frame: when a primitive ends, what it filters, and predictions that frames agree on."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from draccus.utils import ParsingError
from lerobot_policy_hdril import HDRILConfig, HDRILPolicy
from lerobot_policy_hdril.coordinates import Origins, multiply, positive
from lerobot_policy_hdril.decoders import run_gru
from lerobot_policy_hdril.dynamics import StateSkip, ridge_penalty, solve_ridge, usual_windows
from lerobot_policy_hdril.fitting import noise_covariance
from lerobot_policy_hdril.fusion import HAND as HAND_OWNER
from lerobot_policy_hdril.fusion import NO_POSE, FusedMaps, ObjectFrames
from lerobot_policy_hdril.graph import pose_groups, quaternion_groups
from lerobot_policy_hdril.hand_noise import ANGLE, REST, HandNoise
from lerobot_policy_hdril.player import Choice
from lerobot_policy_hdril.presets import PRESETS
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional as F

from tests.policies.test_player import Scripted, play
from tests.policies.tools import BATCH, FRAMES, STARTS, Training, build, demonstrations, observation

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
HAND, CUP, SHELF = ([f"{name}.{axis}" for axis in POSE] for name in ("left_ee", "cup", "shelf"))
STATE = [*HAND, *CUP, *SHELF, "cup.size"]
ACTION = [*HAND, "left_gripper.pos"]
LEAST = [(1e-6, 1e-6, 1e-6)]  # a penalty that hardly matters, on all alike
SHRINKAGE = 0.2


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def turned(count: int, spread: float, draw: torch.Generator) -> Tensor:
    """Unit quaternions (count, 4) within ``spread`` rad of none."""
    angle = spread * (2.0 * torch.rand(count, 1, generator=draw, dtype=torch.float64) - 1.0)
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw, dtype=torch.float64), dim=-1)
    return torch.cat([(angle / 2).sin() * axis, (angle / 2).cos()], dim=-1)


def scenes(count: int, seed: int) -> Tensor:
    """States (count, 22) in which hand, cup and shelf are anywhere, turned by up to 60 degrees."""
    draw = generator(seed)
    parts = []
    for _ in range(3):
        parts += [torch.rand(count, 3, generator=draw, dtype=torch.float64), turned(count, 1.0, draw)]
    return torch.cat([*parts, torch.rand(count, 1, generator=draw, dtype=torch.float64)], dim=-1)


def rotations(quaternions: Tensor) -> Rotation:
    return Rotation.from_quat(quaternions.numpy())


# ---------------------------------------------------------------------- when a primitive is over


class Deciding(Scripted):
    """Wishes with a probability that the primitive that plays goes on."""

    def __init__(self, wishes: list[tuple[int, float]], **config: Any) -> None:
        super().__init__([], **config)
        self.answers = iter(wishes)

    def choose(self, state, previous):
        wish, go_on = next(self.answers)
        begin = (1.0 - go_on) * torch.nn.functional.one_hot(torch.tensor([wish]), 3).float()
        return Choice(begin, None if previous is None else torch.tensor([go_on]), torch.zeros(1, 1, 1))


def test_the_planner_decides_what_goes_on_and_what_begins() -> None:
    wishes = [(0, 0.0), (1, 0.9), (1, 0.9), (1, 0.1), (1, 0.8), (1, 0.2), (0, 0.9), (0, 0.0)]
    states = play(Deciding(wishes), 8)
    played = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 0), (1, 1), (0, 0)]
    assert [(int(s.primitive), int(s.elapsed)) for s in states] == played
    assert states[-1].begun.tolist() == [[2, 2, 0]]


@pytest.mark.parametrize("wish", [0, 1])
def test_a_primitive_goes_on_as_long_as_all_demonstrations_do_whatever_the_planner_says(wish: int) -> None:
    states = play(Deciding([(0, 0.0)] + [(wish, 0.1)] * 3), 4)
    assert [(int(s.primitive), int(s.elapsed)) for s in states] == [(0, 0), (0, 1), (0, 2), (wish, 0)]


def test_a_primitive_ends_at_its_longest_length_whatever_the_planner_says() -> None:
    states = play(Deciding([(0, 0.0)] + [(1, 0.9)] * 5), 6)
    assert [(int(s.primitive), int(s.elapsed)) for s in states][-2:] == [(0, 4), (1, 0)]


@pytest.mark.parametrize(("least", "given_up"), [(0.0, None), (0.3, 15), (0.5, 10), (0.6, 10), (0.7, 5)])
def test_a_primitive_that_would_begin_again_is_given_up_when_doubts_have_added_up(
    least: float, given_up: int | None
) -> None:
    # It is over after five frames. At four of them the planner would have begun another with a probability of a tenth, most often
    # the third: 0.66 are left at the fifth frame, 0.43 at the tenth and 0.28 at the fifteenth.
    wishes = [(0, 0.0), *(((1 if t % 5 == 3 else 2), 0.9) if t % 5 else (0, 0.0) for t in range(1, 16))]
    policy = Deciding(wishes, least_survival=least)
    states = play(policy, 16)
    told = [(int(s.primitive), int(s.gave_up)) for s in states]
    last = 16 if given_up is None else given_up
    assert told[:last] == [(0, -1)] * last
    if given_up is not None:
        assert told[given_up] == (2, 0)
        assert (int(states[given_up].elapsed), states[given_up].doubt.tolist()) == (0, [[0.0, 0.0, 0.0]])


def test_doubts_count_while_a_primitive_goes_on_in_any_case() -> None:
    # Its shortest length is two frames: what the planner says after the first of them does not end it, and is not forgotten.
    wishes = [(0, 0.0), (1, 0.9), (1, 0.9), (1, 0.1), (0, 0.2), (1, 0.1)]
    states = play(Deciding(wishes, least_survival=0.3), 6)
    assert [(int(s.primitive), int(s.elapsed)) for s in states] == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (0, 0)]
    assert states[-1].gave_up.tolist() == [1]


@pytest.mark.parametrize("wishes", [[(0, 0.0)] + [(1, 0.1)] * 3, [(1, 0.0)] + [(0, 0.1)] * 3])
def test_rows_of_a_batch_have_the_shortest_lengths_of_their_own_primitives(wishes: list[tuple[int, float]]) -> None:
    class Both(Scripted):
        def choose(self, state, previous):
            pair = next(self.wishes)
            begin = torch.stack([(1.0 - go) * F.one_hot(torch.tensor(wish), 3).float() for wish, go in pair])
            go_on = None if previous is None else torch.tensor([go for _, go in pair])
            return Choice(begin, go_on, torch.zeros(1, 2, 1))

    mirrored = [(1 - wish, go) for wish, go in wishes]
    both: Any = [list(pair) for pair in zip(wishes, mirrored, strict=True)]
    together = play(Both(both), len(wishes), 2)
    for row, alone in enumerate((wishes, mirrored)):
        single = play(Deciding(alone), len(alone))
        expected = [(int(s.primitive), int(s.elapsed)) for s in single]
        assert [(int(s.primitive[row]), int(s.elapsed[row])) for s in together] == expected


def test_doubts_do_not_end_a_primitive_that_goes_on_and_end_with_it() -> None:
    policy = Deciding([(0, 0.0), (1, 0.6), (1, 0.6), (1, 0.6), (2, 0.3), (2, 0.9)], least_survival=0.9)
    states = play(policy, 6)
    assert [(int(s.primitive), int(s.gave_up)) for s in states] == [(0, -1)] * 4 + [(2, -1)] * 2
    assert states[3].doubt[0].tolist() == pytest.approx([0.0, -3.0 * math.log(0.6), 0.0])
    assert states[4].doubt[0].tolist() == [0.0, 0.0, 0.0]


def test_doubts_of_one_episode_are_not_anothers_and_the_last_frame_counts() -> None:
    class Doubting(Scripted):
        def choose(self, state, previous):
            begin, go_on = next(self.wishes)
            return Choice(torch.tensor(begin), None if previous is None else torch.tensor(go_on), torch.zeros(1, 2, 1))

    sure, unsure = [0.1, 0.0, 0.0], [0.1, 0.2, 0.0]
    first = ([[1.0, 0.0, 0.0]] * 2, [0.0] * 2)
    # At the fifth frame both are over. Of the second one, only this frame says that the third primitive begins.
    last = ([[0.5, 0.0, 0.0], [0.4, 0.0, 0.35]], [0.5, 0.25])
    wishes: Any = [first, *[([sure, unsure], [0.9, 0.7])] * 4, last]
    policy = Doubting(wishes, least_survival=0.3)
    states = play(policy, 6, 2)
    assert states[-1].gave_up.tolist() == [-1, 0]
    assert states[-1].primitive.tolist() == [0, 1]
    assert states[4].doubt[:, 1].tolist() == pytest.approx([0.0, -4.0 * math.log(0.8)])


class Torn(Scripted):
    """It says the same at every frame: how probable the beginning of each primitive is, which never goes on."""

    def __init__(self, says: list[list[float]], **config: Any) -> None:
        super().__init__([], **config)
        self.says, self.shortest_length = torch.tensor(says), torch.ones(3, dtype=torch.long)

    def choose(self, state, previous):
        rows = len(self.says)
        return Choice(self.says, None if previous is None else torch.zeros(rows), torch.zeros(1, rows, 1))


@pytest.mark.parametrize(
    ("discount", "begun"), [(0.0, [1, 1, 1, 1, 1, 1]), (0.3, [1, 1, 0, 1, 0, 1]), (0.5, [1, 0, 1, 0, 1, 2])]
)
def test_what_has_begun_before_counts_for_less_where_a_primitive_begins(discount: float, begun: list[int]) -> None:
    states = play(Torn([[0.35, 0.55, 0.1]], repeat_discount=discount), 6)
    assert [int(s.primitive) for s in states] == begun
    assert all(int(s.elapsed) == 0 for s in states)
    assert states[-1].probabilities.tolist() == [pytest.approx([0.35, 0.55, 0.1])], "the planner's own"


def test_what_has_begun_often_is_chosen_again_where_the_planner_is_sure() -> None:
    states = play(Torn([[0.1, 0.9, 0.0]], repeat_discount=0.5), 20)
    assert [int(s.primitive) for s in states] == [1] * 20
    # After three beginnings its 0.88 count as 0.11, and no less after that.
    states = play(Torn([[0.12, 0.88, 0.0]], repeat_discount=0.5), 20)
    assert [int(s.primitive) for s in states] == [*[1] * 3, 0, *[1] * 16]


@pytest.mark.parametrize(("discount", "passed_over"), [(0.0, [-1] * 6), (0.5, [-1, 1, -1, 1, -1, 1])])
def test_what_the_planner_preferred_and_what_did_not_begin_is_told(discount: float, passed_over: list[int]) -> None:
    states = play(Torn([[0.35, 0.55, 0.1]], repeat_discount=discount), 6)
    assert [int(s.passed_over) for s in states] == passed_over
    assert all(int(s.gave_up) == -1 for s in states)


def test_forms_of_a_primitive_begin_together() -> None:
    policy = Torn([[0.5, 0.3, 0.2]], repeat_discount=0.5)
    # The first two are forms of one primitive: when the first has begun, the second is as often begun.
    policy.alike[0, 1] = policy.alike[1, 0] = True
    states = play(policy, 4)
    assert [int(s.primitive) for s in states] == [0, 0, 2, 0]
    assert [s.begun.tolist() for s in states] == [[[1, 1, 0]], [[2, 2, 0]], [[2, 2, 1]], [[3, 3, 1]]]


class Frames(Scripted):
    """It says frame by frame how probable it is in each episode that a primitive begins. What plays goes on with the rest."""

    def __init__(self, says: list[list[list[float]]], **config: Any) -> None:
        super().__init__([], **config)
        self.said = iter(says)
        self.shortest_length, self.longest_length = torch.ones(3, dtype=torch.long), torch.full((3,), 4)

    def choose(self, state, previous):
        begin = torch.tensor(next(self.said))
        return Choice(begin, None if previous is None else 1.0 - begin.sum(-1), torch.zeros(1, len(begin), 1))


@pytest.mark.parametrize(
    ("discount", "at_the_end", "begins", "gave_up", "passed_over"),
    [
        # The first primitive has begun twice and the second, which plays, once. Most doubts were that it is the first.
        (0.0, [0.0, 1.0, 0.0], 0, 1, -1),
        (0.5, [0.0, 1.0, 0.0], 2, 1, -1),
        # What the planner prefers has begun too often, and what plays has failed: neither begins.
        (0.0, [0.5, 0.3, 0.2], 0, -1, -1),
        (0.5, [0.6, 0.35, 0.05], 2, -1, 0),
        # What plays is no longer the first choice once it is discounted, so that doubts have nothing to say.
        (0.0, [0.0, 0.6, 0.4], 2, 1, -1),
        (0.5, [0.0, 0.6, 0.4], 2, -1, 1),
    ],
)
def test_what_is_given_up_is_followed_by_what_has_begun_less_often(
    discount: float, at_the_end: list[float], begins: int, gave_up: int, passed_over: int
) -> None:
    says = [[[1.0, 0.0, 0.0]]] * 2 + [[[0.0, 1.0, 0.0]]] + [[[0.12, 0.0, 0.08]]] * 3 + [[at_the_end]]
    states = play(Frames(says, least_survival=0.6, repeat_discount=discount), len(says))
    assert [int(s.primitive) for s in states] == [0, 0, 1, 1, 1, 1, begins]
    assert states[-2].begun.tolist() == [[2, 1, 0]]
    assert (int(states[-1].elapsed), int(states[-1].gave_up), int(states[-1].passed_over)) == (0, gave_up, passed_over)
    assert all(int(s.gave_up) == int(s.passed_over) == -1 for s in states[:-1])


def test_what_is_passed_over_or_given_up_in_one_episode_of_a_batch_is_not_in_another() -> None:
    states = play(Torn([[0.35, 0.55, 0.1], [0.1, 0.9, 0.0]], repeat_discount=0.5), 4, 2)
    assert [s.passed_over.tolist() for s in states] == [[-1, -1], [1, -1], [-1, -1], [1, -1]]

    begins = [[[1.0, 0.0, 0.0]] * 2] * 2 + [[[0.0, 1.0, 0.0]] * 2] + [[[0.12, 0.0, 0.08]] * 2] * 3
    policy = Frames([*begins, [[0.0, 1.0, 0.0], [0.6, 0.35, 0.05]]], least_survival=0.6, repeat_discount=0.5)
    last = play(policy, 7, 2)[-1]
    assert (last.primitive.tolist(), last.gave_up.tolist(), last.passed_over.tolist()) == ([2, 2], [1, -1], [-1, 0])


def test_three_beginnings_count_at_most_against_what_most_doubts_speak_for() -> None:
    # A tenth as many doubts speak for the third one, which has never begun: it would be next if a fourth beginning counted.
    says = [[[1.0, 0.0, 0.0]]] * 4 + [[[0.0, 1.0, 0.0]]] + [[[0.1, 0.0, 0.01]]] * 3 + [[[0.0, 1.0, 0.0]]]
    states = play(Frames(says, least_survival=0.9, repeat_discount=0.5), len(says))
    assert states[-2].begun.tolist() == [[4, 1, 0]]
    assert (int(states[-1].primitive), int(states[-1].gave_up)) == (0, 1)


def test_what_has_begun_before_does_not_keep_what_plays_from_going_on_or_another_from_beginning() -> None:
    wishes = [(0, 0.0), (1, 0.9), (1, 0.9), (1, 0.4), (0, 0.6), (0, 0.4), (0, 0.6), (0, 0.6)]
    discounted, plain = (play(Deciding(wishes, repeat_discount=share), len(wishes)) for share in (0.9, 0.0))
    assert [(int(s.primitive), int(s.elapsed)) for s in discounted] == [
        (int(s.primitive), int(s.elapsed)) for s in plain
    ]


def test_what_has_begun_in_one_episode_of_a_batch_does_not_count_in_another() -> None:
    states = play(Torn([[0.35, 0.55, 0.1], [0.8, 0.15, 0.05]], repeat_discount=0.5), 4, 2)
    assert [s.primitive.tolist() for s in states] == [[1, 0], [0, 0], [1, 0], [0, 1]]


def test_what_goes_on_counts_as_the_primitive_that_plays() -> None:
    states = play(Deciding([(0, 0.0), (1, 0.75)]), 2)
    assert states[1].probabilities.tolist() == [[0.75, 0.25, 0.0]]


@pytest.mark.parametrize("filters", [[], [3], [3, 5], [5, 3]])
def test_the_filters_are_means_of_the_last_states(filters: list[int]) -> None:
    policy = Scripted([[0]] * 6, replan_every=1, filters=filters)
    states = play(policy, 6)
    assert [s.recent.shape[1] for s in states] == [min(t, max(filters, default=1)) for t in range(1, 7)]
    means = {3: [0.0, 0.5, 1.0, 2.0, 3.0, 4.0], 5: [0.0, 0.5, 1.0, 1.5, 2.0, 3.0]}
    assert policy.means == [[[means[frames][t] for frames in filters]] for t in range(6)]


def test_histories_say_what_played_and_what_begins(metadata) -> None:
    data = demonstrations(build(metadata))
    history = data.history(torch.tensor([FRAMES + 3]))
    assert history.begins[0].nonzero().flatten().tolist() == STARTS
    assert history.playing[0, :12].tolist() == [6] + [0] * 10 + [1]
    assert history.elapsed[0, :13].tolist() == [*range(11), 1, 2]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, [8, 24]),
        ({"filter_frames": 5}, [5, 24]),
        ({"filter_frames": 1}, [24]),
        ({"long_filter_frames": 1}, [8]),
        ({"filter_frames": 24}, [24]),
        ({"filter_frames": 30}, [24, 30]),
        ({"filter_frames": 1, "long_filter_frames": 1}, []),
    ],
)
def test_the_filters_of_the_demonstrations_are_those_of_the_policy(
    values: dict[str, int], expected: list[int], metadata, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = build(metadata, preset="hdril_reactive", hidden_dim=32, **values).eval()
    data, seen = demonstrations(policy), []
    assert policy.config.filters == expected
    plan = policy.plan
    monkeypatch.setattr(policy, "plan", lambda *given: seen.append(given[0][0]) or plan(*given))
    for t in range(30):
        policy.select_action(observation(metadata, [FRAMES + t]))
        if len(seen) > t:  # a plan was made at this frame
            torch.testing.assert_close(seen[-1], data.seen[FRAMES + t])
        else:
            seen.append(None)
    assert torch.equal(data.seen[:, 0], data.state)
    for t, frames in enumerate(expected):
        for last in (0, 3, 29):
            mean = data.state[FRAMES + max(last + 1 - frames, 0) : FRAMES + last + 1].mean(0)
            torch.testing.assert_close(data.seen[FRAMES + last, 1 + t], mean)


@pytest.mark.parametrize("values", [{}, {"coordinates": "relational"}, {"preset": "network_reactive"}])
def test_the_maps_see_the_state_first_and_then_each_mean(values: dict[str, Any], metadata) -> None:
    """Checkpoints hold maps for this order. The network and the frames of what is planned go by the state alone."""
    policy = build(metadata, **values, filter_frames=4, long_filter_frames=9, hidden_dim=32).eval()
    torch.nn.init.normal_(policy.dynamics[0].head[-1].weight)  # type: ignore[union-attr, index, arg-type]
    seen = torch.cat([demonstrations(policy).seen[[5, 20, 70]], demonstrations(policy).seen[[8, 30, 95]]])
    assert seen.shape[1] == 3
    parts = seen.unbind(1)
    alone = torch.cat([policy.dynamics_input(part) for part in parts], dim=-1)
    torch.testing.assert_close(policy.linear_input(seen), alone)
    primitive, elapsed = torch.zeros(6, dtype=torch.long), torch.zeros(6, dtype=torch.long)
    other = torch.cat([seen[:, :1], seen[:, 1:].flip(0)], dim=1)
    if policy.frames is None:
        skip = policy.model_of(0).state_skip
        assert skip is not None
        assert not torch.equal(policy.plan(other, primitive, elapsed), policy.plan(seen, primitive, elapsed))
        skip.weight[..., len(parts[0][0]) :] = 0.0
        assert torch.equal(policy.plan(other, primitive, elapsed), policy.plan(seen, primitive, elapsed))
        return
    told, size = policy.features(seen)[0][:, : policy.frames.dim], len(parts[0][0])
    told = told * policy.feature_std + policy.feature_mean
    for i, part in enumerate(parts):
        torch.testing.assert_close(told[:, i * size : (i + 1) * size], part)
    network = [policy._network(given, primitive, elapsed)[0] for given in (seen, other)]
    assert torch.equal(*network)


def test_a_trained_planner_goes_through_the_primitives(metadata) -> None:
    training = Training(build(metadata, preset="hdril_reactive", hidden_dim=32, planner_batch_size=6), 60)
    for _ in range(60):
        training.step(BATCH)
    policy = training.policy.eval()
    starts = []
    for t in range(FRAMES):
        policy.select_action(observation(metadata, [t]))
        assert policy._playback is not None
        starts += [t] if policy._playback.elapsed.item() == 0 else []
    assert starts == STARTS


# ---------------------------------------------------------------------- robust fits


def test_leave_one_out_errors_are_those_of_maps_without_the_row() -> None:
    draw = generator()
    x = torch.cat([torch.randn(30, 4, generator=draw, dtype=torch.float64), torch.ones(30, 1).double()], dim=1)
    y, penalty = torch.randn(30, 2, generator=draw, dtype=torch.float64), ridge_penalty(x, 0.5)
    _, errors = solve_ridge(x, y, penalty)
    for row in (0, 17):
        rest = torch.arange(30) != row
        without, _ = solve_ridge(x[rest], y[rest], penalty)
        torch.testing.assert_close(errors[row], y[row] - without @ x[row])


def test_windows_that_are_far_off_are_left_out() -> None:
    draw = generator()
    x = torch.cat([torch.randn(200, 4, generator=draw, dtype=torch.float64), torch.ones(200, 1).double()], dim=1)
    y = x @ torch.randn(5, 3, generator=draw, dtype=torch.float64) + 0.001 * torch.randn(200, 3, generator=draw)
    y[::20] += 0.1
    assert torch.equal(usual_windows(x, y, ridge_penalty(x, 1e-6)), torch.arange(200) % 20 != 0)


@pytest.mark.parametrize("robust", [True, False])
def test_a_robust_map_is_not_moved_by_what_went_wrong(robust: bool) -> None:
    draw = generator()
    states, truth = torch.randn(200, 4, generator=draw).double(), torch.randn(3, 4, generator=draw).double()
    target = (states @ truth.T + 0.001 * torch.randn(200, 3, generator=draw))[:, None]
    target[::20] += 0.3
    skip, mask = StateSkip(4, 3, 1, 1), torch.ones(200, 1, dtype=torch.bool)
    skip.fit(states, torch.zeros(200, 1).long(), target, mask, 1e-3, torch.ones(3).double() if robust else None)
    assert (bool(skip.bias.abs().max() < 1e-3)) is robust


# ---------------------------------------------------------------------- frames


def test_poses_are_seen_from_a_frame_and_placed_by_it() -> None:
    frame, poses = scenes(6, 8)[:, :7], scenes(18, 9)[:, :7].reshape(6, 3, 7)
    poses[1::2, 1, 3:] *= -1.0  # the same rotation
    origins = Origins.at(frame[:, :3], frame[:, 3:])
    seen = origins.see(poses)
    for i in range(6):
        turn = rotations(frame[i, 3:]).inv()
        expected = torch.from_numpy(turn.apply(poses[i, :, :3] - frame[i, :3]))
        torch.testing.assert_close(seen[i, :, :3], expected)
        torch.testing.assert_close(
            seen[i, :, 3:], multiply(torch.from_numpy(turn.as_quat()).expand(3, 4), poses[i, :, 3:])
        )
        expected = (turn * rotations(poses[i, :, 3:])).as_quat(canonical=True)
        torch.testing.assert_close(positive(seen[i])[:, 3:], torch.from_numpy(expected))
    torch.testing.assert_close(origins.place(seen), poses)
    with torch.autocast("cpu", torch.bfloat16):  # bfloat16 would lose millimetres of a metre
        coarse = Origins.at(frame[:, :3].float(), frame[:, 3:].float())
        torch.testing.assert_close(coarse.see(poses.float()), seen.float())
        torch.testing.assert_close(coarse.place(seen.float()), poses.float())


def test_an_object_may_have_the_only_pose() -> None:
    frames = ObjectFrames(["left.joint", *CUP], CUP, ACTION).double()
    states = torch.cat([torch.rand(5, 1).double(), scenes(5, 0)[:, :7]], dim=-1)
    torch.testing.assert_close(frames.features(states[:, None]), states)
    assert frames.dim == 8


def test_each_step_of_a_plan_has_maps_of_its_own_by_where_the_plan_starts() -> None:
    frames, states = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION).double(), scenes(400, 2)
    maps, start = FusedMaps(frames, 2, 2).double(), torch.arange(400) % 2

    def actions(states: Tensor, start: Tensor) -> Tensor:
        """The hand is by the cup, 10 cm further along its axis at each step, and 40 cm in plans that start later."""
        plan = torch.cat([at_cup(states), states[:, -1:]], dim=-1)[:, None].repeat(1, 2, 1)
        axis = torch.from_numpy(rotations(states[:, 10:14]).apply([0.0, 0.0, 1.0]))[:, None]
        plan[..., :3] += (0.1 * torch.arange(2) + 0.4 * start[:, None])[..., None] * axis
        return plan

    noise = torch.zeros(frames.dim, frames.dim)
    mask = torch.ones(400, 2, dtype=torch.bool)
    seen = states[:, None]
    maps.fit(frames.features(seen), start, frames, seen, actions(states, start), mask, LEAST, False, noise, SHRINKAGE)
    states, start = scenes(20, 3), torch.arange(20) // 3 % 2
    told = maps(frames.features(states[:, None]), start, frames, frames.origins(states[:, None]))
    torch.testing.assert_close(told[..., :3], actions(states, start)[..., :3], atol=2e-3, rtol=0)


def test_a_gru_step_by_step_is_the_gru() -> None:
    gru, inputs = torch.nn.GRU(3, 5, batch_first=True), torch.randn(2, 4, 3, generator=generator())
    expected, last = gru(inputs)
    hidden, path = None, []
    for step in inputs.split(1, dim=1):
        output, hidden = run_gru(gru, step, hidden)
        path.append(output)
    torch.testing.assert_close(torch.cat(path, dim=1), expected)
    torch.testing.assert_close(hidden, last)
    torch.testing.assert_close(run_gru(gru, inputs)[0], expected)


def test_mixed_precision_moves_a_plan_by_less_than_a_millimetre(metadata) -> None:
    policy = build(metadata, preset="hdril_reactive").eval()
    window = demonstrations(policy).window(BATCH, 2, 2)
    seen = window.seen, window.primitive, window.elapsed
    plan = policy.plan(*seen)
    with torch.autocast("cpu", torch.bfloat16):
        coarse = policy.plan(*seen)
    torch.testing.assert_close(coarse[..., 1:4], plan[..., 1:4], atol=1e-3, rtol=0)


def test_what_objects_see_does_not_change_when_the_world_is_moved() -> None:
    frames, draw = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION).double(), generator(1)
    states, turn, shift = scenes(5, 0), rotations(turned(1, 0.5, draw)), torch.tensor([0.3, -1.0, 0.2]).double()
    moved = states.clone()
    for pose in pose_groups(STATE):
        moved[:, pose[:3]] = torch.from_numpy(turn.apply(states[:, pose[:3]])) + shift
        moved[:, pose[3:]] = torch.from_numpy((turn * rotations(states[:, pose[3:]])).as_quat())
    moved[1::2, 10:14] *= -1.0  # the same rotation
    before, after = frames.features(states[:, None]), frames.features(moved[:, None])
    assert before.shape == (5, frames.dim) == (5, 22 + 2 * 2 * 7)
    torch.testing.assert_close(after[:, 22:], before[:, 22:])
    torch.testing.assert_close(before[:, :22], states)


def views(count: int, seed: int) -> Tensor:
    """Three states (count, 3, 22), as a state and two means of others."""
    return torch.stack([scenes(count, seed + i) for i in range(3)], dim=1)


def pose_seen_from(frame: Tensor, pose: Tensor) -> Tensor:
    """Poses (N, 7) from frames (N, 7), w >= 0."""
    turn = rotations(frame[:, 3:]).inv()
    place = turn.apply(pose[:, :3] - frame[:, :3])
    quaternion = (turn * rotations(pose[:, 3:])).as_quat(canonical=True)
    return torch.cat([torch.from_numpy(place), torch.from_numpy(quaternion)], dim=-1)


def columns_of(frames: ObjectFrames, **wanted: int) -> list[int]:
    """Features of which all this is true."""
    here = torch.ones(frames.dim, dtype=torch.bool)
    for name, value in wanted.items():
        here &= getattr(frames, name) == value
    return here.nonzero().flatten().tolist()


def test_an_object_gives_a_frame_in_every_view_and_sees_the_hands_as_they_are_now() -> None:
    frames, seen = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION, 3).double(), views(5, 20)
    told, places = frames.features(seen), {HAND_OWNER: HAND, 0: CUP, 1: SHELF}
    assert told.shape == (5, frames.dim)
    columns = {owner: [STATE.index(name) for name in names] for owner, names in places.items()}
    found = columns_of(frames, seen_from=0)
    for view in range(3):
        for frame in range(2):
            origin, number = seen[:, view, columns[frame]], 1 + 2 * view + frame
            looked = {(HAND_OWNER, 0), (HAND_OWNER, view), (1 - frame, view)}
            for owner, of in looked:
                here = columns_of(frames, seen_from=number, view=of, owner=owner)
                torch.testing.assert_close(told[:, here], pose_seen_from(origin, seen[:, of, columns[owner]]))
                found += here
            origins = frames.origins(seen)[number]
            torch.testing.assert_close(origins.position, origin[:, :3])
            torch.testing.assert_close(origins.rotation, torch.from_numpy(rotations(origin[:, 3:]).as_matrix()))
    assert sorted(found) == list(range(frames.dim))


def test_a_feature_is_like_that_of_a_single_view() -> None:
    frames, states = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION, 3).double(), scenes(5, 0)
    still = states[:, None].expand(5, 3, 22)
    torch.testing.assert_close(frames.single(states)[:, frames.alike], frames.features(still))


@pytest.mark.parametrize("moved", [(), ("cup",), ("cup", "shelf")])
def test_a_map_sees_most_freely_what_its_frame_shows(moved: tuple[str, ...]) -> None:
    """Feature by feature, what the docstring says."""
    names, things = [*STATE, "left_gripper.pos", "goal.x"], ["cup", "shelf"]
    frames = ObjectFrames(names, [*CUP, *SHELF, "cup.size", "goal.x"], ACTION, 2).double()
    penalties = frames.penalties(torch.tensor([name in moved for name in things]), 1.0, 30.0, 300.0)
    owners = {HAND_OWNER: "left", 0: "cup", 1: "shelf", NO_POSE: "goal"}
    for number, row in enumerate(penalties.tolist()):
        view, own = (0, "") if not number else divmod(number - 1, 2)
        own = own if own == "" else things[int(own)]
        for column, penalty in enumerate(row):
            owner, of = owners[int(frames.owner[column])], int(frames.view[column])
            here, is_pose = int(frames.seen_from[column]) == number, bool(frames.of_pose[column])
            if not is_pose:
                light = of == 0 and owner in ("left", "goal", own, *moved)
                expected = 1.0 if light else 300.0
            elif owner == "left" and of == 0:
                expected = 1.0 if here else 30.0 if int(frames.seen_from[column]) == 0 else 300.0
            elif owner == "left":
                expected = 1.0 if here and of == view and moved else 300.0
            else:
                expected = 300.0 if not here or of != view else 1.0 if owner in moved else 30.0
            assert penalty == expected, (number, column)


def test_what_has_moved_is_far_from_its_longest_mean_in_most_demonstrations() -> None:
    frames, still = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION, 3).double(), scenes(9, 0)
    seen = still[:, None].repeat(1, 3, 1)
    assert frames.moved(seen).tolist() == [False, False]
    seen[:5, 2, STATE.index("shelf.y")] += 0.031
    seen[:4, 2, STATE.index("cup.x")] -= 0.5
    seen[:, 1, STATE.index("cup.x")] += 0.5  # a shorter mean
    assert frames.moved(seen).tolist() == [False, True]


def test_the_maps_are_those_of_the_penalties_that_serve_a_frame_best() -> None:
    """Each start, step and frame, solved alone: penalties by what has moved, a choice by errors that the noise adds to."""
    frames, draw = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION, 3).double(), generator(30)
    ridges = [(3.0, 3.0, 3.0), (1e-3, 1.0, 30.0), (1e-3, 1e-3, 1e-3)]
    seen = views(120, 40)
    start, mask = torch.arange(120) % 2, torch.ones(120, 2, dtype=torch.bool)
    seen[start == 0, 1:] = seen[start == 0, :1]  # nothing has moved
    mask[::6, 1] = False  # at both starts a few last for a frame less; at the second, all reach the second frame
    mask[1::6, 1] = True
    target = at_cup(seen[:, 0])
    target[:, :3] = 0.5 * target[:, :3] + 0.5 * seen[:, 0, :3] + 0.05 * torch.randn(120, 3, generator=draw)
    openings = seen[:, 0, 21:] + 0.1 * torch.randn(120, 1, generator=draw)
    action = torch.cat([target, openings], dim=-1)[:, None].repeat(1, 2, 1)
    action[:, 1, :3] += 0.1 * torch.rand(120, 3, generator=draw)
    features = frames.features(seen)
    features = (features - features.mean(0)) / features.std(0)
    noise = torch.diag(0.3 * torch.rand(frames.dim, generator=draw).double())
    maps = FusedMaps(frames, 2, 2).double()
    for wrong in (-action, action):  # a fit begins anew
        maps.fit(features, start, frames, seen, wrong, mask, ridges, False, noise, SHRINKAGE)
    x, noise = torch.cat([features, torch.ones(120, 1).double()], dim=-1), F.pad(noise, (0, 1, 0, 1))
    poses, chosen = frames.targets(action, seen)[..., 0, :3], set()
    axes = frames.origins(seen).rotation
    for first in range(2):
        rows = start == first
        penalties = [frames.penalties(frames.moved(seen[rows]), *ridge) for ridge in ridges]
        apart: list[list[tuple[Tensor, Tensor]]] = [
            [],
            [],
        ]  # by step and frame: whitened errors (N, 3), what shakes them
        together = bool(mask[rows].all())
        for frame in range(frames.count):
            tried: list[list[tuple[float, Tensor, Tensor, Tensor]]] = []
            for step in range(2):
                here = rows & mask[:, step]
                tried.append([])
                for penalty in penalties:
                    full = torch.diag(F.pad(penalty[frame], (0, 1), value=1e-6)) + here.sum() * noise
                    y = torch.cat([poses[frame, here, step], action[here, step, 7:]], dim=-1)
                    solved, far = solve_ridge(x[here], y, full)
                    spread = far.T @ far / here.sum() + solved @ noise @ solved.T
                    tried[-1].append((float(spread[:3, :3].trace()), solved, spread, far))
            for step in range(2):
                scores = [sum(tried[s][c][0] for s in ((0, 1) if together else (step,))) for c in range(3)]
                best = next(c for c in range(3) if scores[c] <= 2.0 * min(scores))
                chosen.add((frame, best))
                _, solved, spread, far = tried[step][best]
                torch.testing.assert_close(maps.weight[frame, first, step, :3], solved[:3])
                expected = torch.linalg.inv(spread[:3, :3] + 1e-7 * torch.eye(3))
                root = maps.whitening[frame, first, step, 0]
                torch.testing.assert_close(root @ root, expected)
                torch.testing.assert_close(root, root.T)
                if frame == 0:
                    torch.testing.assert_close(maps.plain[first, step], solved[3:])
                turned = axes[frame, rows & mask[:, step]] @ root
                apart[step].append(((turned @ far[:, :3, None]).squeeze(-1), turned @ solved[:3]))
        for step in range(2):
            correlation = torch.eye(frames.count).double()
            for f, (errors, shaken) in enumerate(apart[step]):
                for g, (others, also) in enumerate(apart[step][:f]):
                    by_noise = torch.einsum("nia,ab,nib->n", shaken, noise, also)
                    correlation[f, g] = correlation[g, f] = ((errors * others).sum(-1) + by_noise).mean() / 3.0
            assert (correlation - torch.eye(frames.count)).abs().max() > 0.5
            expected = torch.linalg.inv(0.8 * correlation + 0.2 * torch.eye(frames.count))
            torch.testing.assert_close(maps.agreement[first, step, 0], expected, atol=1e-5, rtol=1e-5)
    assert len({best for frame, best in chosen if frame}) > 1
    assert {best for frame, best in chosen if not frame} != {best for frame, best in chosen if frame}


def test_robust_maps_leave_out_what_is_far_off_at_each_start() -> None:
    frames, draw = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION).double(), generator(31)
    seen, start = scenes(400, 2)[:, None], torch.arange(400) % 2
    action = torch.cat([at_place(seen[:, 0]), torch.zeros(400, 1).double()], dim=-1)[:, None]
    action[..., :3] += 1e-3 * torch.randn(400, 1, 3, generator=draw) + 0.2 * start[:, None, None]
    wrong = action.clone()
    wrong[::15, :, :3] += 0.5
    mask, noise = torch.ones(400, 1, dtype=torch.bool), torch.zeros(frames.dim, frames.dim)
    ridges = [(1e-3, 1e-3, 1e-3), (1e6, 1e6, 1e6)]
    places = []
    for given, robust in ((action, False), (wrong, False), (wrong, True)):
        maps = FusedMaps(frames, 2, 1).double()
        maps.fit(frames.features(seen), start, frames, seen, given, mask, ridges, robust, noise, SHRINKAGE)
        places.append(maps(frames.features(seen), start, frames, frames.origins(seen))[:, 0, :3])
    assert (places[1] - places[0]).norm(dim=-1).mean() > 0.01
    torch.testing.assert_close(places[2], places[0], atol=2e-3, rtol=0)


@pytest.mark.parametrize(("late", "alone"), [(50, True), (49, False)])
def test_starts_that_few_executions_reach_share_maps_with_the_one_before(late: int, alone: bool) -> None:
    frames = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION).double()
    maps, seen = FusedMaps(frames, 4, 1).double(), scenes(200 + late, 2)[:, None]
    start = torch.tensor([0] * 100 + [1] * 100 + [2] * late)
    action = torch.cat([at_cup(seen[:, 0]), 0.1 * start[:, None].double()], dim=-1)[:, None]
    mask, noise = torch.ones(len(seen), 1, dtype=torch.bool), torch.zeros(frames.dim, frames.dim)
    maps.fit(frames.features(seen), start, frames, seen, action, mask, LEAST, False, noise, SHRINKAGE)
    told = [maps(frames.features(seen), torch.full_like(start, s), frames, frames.origins(seen)) for s in range(4)]
    openings = [float(part[..., 7].mean()) for part in told]
    assert openings[:2] == pytest.approx([0.0, 0.1 if alone else 0.1 + 0.1 * late / (100 + late)], abs=0.01)
    assert (openings[2] == pytest.approx(0.2, abs=0.01)) is alone
    assert torch.equal(told[2], told[3])
    assert torch.equal(told[1], told[2]) is not alone


def test_a_quaternion_of_the_other_sign_is_nothing_unusual() -> None:
    frames, states = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION).double(), scenes(200, 2)
    states[:, 10:14] = turned(200, 0.2, generator(4))
    action = torch.cat([at_cup(states), torch.zeros(200, 1).double()], dim=-1)[:, None]
    action[..., :3] += 1e-3 * torch.randn(200, 1, 3, generator=generator(5))
    other = action.clone()
    other[3::10, :, 3:7] *= -1.0
    seen, start, mask = states[:, None], torch.zeros(200, dtype=torch.long), torch.ones(200, 1, dtype=torch.bool)
    noise, fitted = torch.zeros(frames.dim, frames.dim), []
    for given in (action, other):
        maps = FusedMaps(frames, 1, 1).double()
        maps.fit(frames.features(seen), start, frames, seen, given, mask, LEAST, True, noise, SHRINKAGE)
        fitted.append(maps)
    for one, same in zip(fitted[0].buffers(), fitted[1].buffers(), strict=True):
        torch.testing.assert_close(one, same)


@pytest.mark.parametrize(("longer", "shown"), [(50, True), (49, False), (1, False), (0, False)])
def test_a_step_that_few_windows_reach_is_as_the_one_before(longer: int, shown: bool) -> None:
    frames = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION).double()
    maps, seen = FusedMaps(frames, 2, 3).double(), scenes(100, 2)[:, None]
    start = torch.zeros(100, dtype=torch.long)
    action = torch.cat([at_cup(seen[:, 0]), torch.zeros(100, 1).double()], dim=-1)[:, None].repeat(1, 3, 1)
    action[..., 2] += 0.1 * torch.arange(3)
    mask, noise = torch.ones(100, 3, dtype=torch.bool), torch.zeros(frames.dim, frames.dim)
    mask[longer:, 2] = False
    maps.fit(frames.features(seen), start, frames, seen, action, mask, LEAST, False, noise, SHRINKAGE)
    for late in (start, start + 1):  # which share the maps
        told = maps(frames.features(seen), late, frames, frames.origins(seen))
        rise = (told[..., 2] - action[:, :1, 2]).mean(0)
        assert rise.tolist() == pytest.approx([0.0, 0.1, 0.2 if shown else 0.1], abs=0.01)
        assert torch.equal(told[:, 1], told[:, 2]) is not shown


def test_a_plan_tells_the_first_frame_of_the_next_one(metadata) -> None:
    # Of demonstrations that agree, at every frame at which a plan is made.
    policy = build(metadata, preset="hdril_reactive", fourier_features=0).eval()
    data = demonstrations(policy)
    everything = torch.ones(len(data.episode_index), dtype=torch.bool)
    rows = data.replan_rows(2, everything)
    first = data.window(rows, 2, 3)
    goes_on = first.mask[:, 2]
    told = policy.plan(first.seen, first.primitive, first.elapsed)[goes_on]
    later = data.window(rows[goes_on] + 2, 2, 1).target[:, 0]
    actions = len(policy.config.action_names)
    assert goes_on.sum() > 20
    far = (told[:, 2, :actions] - later[:, :actions]).abs().amax(-1)
    near = (told[:, 0, :actions] - first.target[goes_on, 0, :actions]).abs().amax(-1)
    assert max(near.median(), far.median()) < 5e-3  # with maps of other starts, 1 cm and more


def test_from_few_demonstrations_it_helps_to_know_what_a_frame_sees() -> None:
    """The hand is to go half of the way to the cup's side; what is seen from elsewhere says nothing."""
    frames, noise = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION, 3).double(), 2e-3

    def errors(*ridges: tuple[float, float, float]) -> float:
        maps, train, test = FusedMaps(frames, 1, 1).double(), views(20, 40), views(200, 60)

        def told(seen: Tensor) -> Tensor:
            goal = at_cup(seen[:, 0])
            goal[:, :3] = 0.5 * goal[:, :3] + 0.5 * seen[:, 0, :3]
            return goal

        action = torch.cat([told(train), torch.zeros(20, 1).double()], dim=-1)[:, None]
        action[..., :3] += noise * torch.randn(20, 1, 3, generator=generator(9))
        features = [frames.features(seen) for seen in (train, test)]
        mean, std = features[0].mean(0), features[0].std(0)
        inputs = [(part - mean) / std for part in features]
        start, mask = torch.zeros(20, dtype=torch.long), torch.ones(20, 1, dtype=torch.bool)
        quiet = torch.zeros(frames.dim, frames.dim)
        maps.fit(inputs[0], start, frames, train, action, mask, ridges, False, quiet, SHRINKAGE)
        given = maps(inputs[1], torch.zeros(200, dtype=torch.long), frames, frames.origins(test))
        return (given[:, 0, :3] - told(test)[:, :3]).norm(dim=-1).mean().item()

    freely, alike, nothing = (0.1, 3.0, 30.0), (0.1, 0.1, 0.1), (1e4, 1e4, 1e4)
    assert errors(freely) < 0.5 * errors(alike)
    assert errors(nothing) > 2.0 * errors(freely)
    assert errors(nothing, freely) < 1.2 * errors(freely)  # the leave-one-out errors choose


def fitted(target: Any, count: int = 300, starts: int = 1) -> tuple[FusedMaps, ObjectFrames]:
    """Maps that were fitted to actions ``target(state)`` (N, 7) and a hand that is open by the cup's size, at the first start."""
    frames = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION).double()
    maps, states = FusedMaps(frames, starts, 1).double(), scenes(count, 2)
    action = torch.cat([target(states), states[:, -1:]], dim=-1)[:, None]
    mask = torch.ones(count, 1, dtype=torch.bool)
    start = torch.zeros(count, dtype=torch.long)
    seen, noise = states[:, None], torch.zeros(frames.dim, frames.dim)
    maps.fit(frames.features(seen), start, frames, seen, action, mask, LEAST, False, noise, SHRINKAGE)
    return maps, frames


def at_cup(states: Tensor) -> Tensor:
    """10 cm before the cup and 20 to its side, turned with it."""
    beside = torch.from_numpy(rotations(states[:, 10:14]).apply([0.1, 0.2, 0.0]))
    return torch.cat([beside + states[:, 7:10], states[:, 10:14]], dim=-1)


def at_place(states: Tensor) -> Tensor:
    """The same place in the world, whatever stands where."""
    return torch.tensor([0.4, 0.1, 0.3, 0.0, 0.6, 0.0, 0.8]).double().expand(len(states), 7)


@pytest.mark.parametrize(("target", "best"), [(at_cup, 1), (at_place, 0)])
def test_the_frame_in_which_demonstrations_agree_decides(target: Any, best: int) -> None:
    maps, frames = fitted(target)
    states = scenes(20, 3)
    seen = states[:, None]
    action = maps(frames.features(seen), torch.zeros(20, dtype=torch.long), frames, frames.origins(seen))[:, 0]
    expected = target(states)
    torch.testing.assert_close(action[:, :3], expected[:, :3], atol=2e-3, rtol=0)
    dot = (action[:, 3:7] * expected[:, 3:]).sum(-1).abs()
    assert dot.min() > 1.0 - 1e-4
    torch.testing.assert_close(action[:, 7], states[:, -1], atol=1e-3, rtol=0)
    spread = (
        torch.linalg.inv(maps.whitening[:, 0, 0, 0] @ maps.whitening[:, 0, 0, 0]).diagonal(dim1=-2, dim2=-1).sum(-1)
    )
    assert int(spread.argmin()) == best
    assert spread.sort().values[1] > 10.0 * spread.min()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_predictions_are_fused_by_their_joint_covariance(dtype: torch.dtype) -> None:
    """Generalised least squares; in single precision too, where a frame is certain to a millimetre alone."""
    maps, frames = fitted(at_cup, starts=2)
    states, draw, count = scenes(20, 3), generator(4), 3
    spread = torch.tensor([1e-6, 1e-3, 1e-2]).double()[torch.randint(3, (count, 3), generator=draw)]
    turns = torch.linalg.qr(torch.randn(count, 3, 3, generator=draw).double()).Q
    maps.whitening[:, 1, 0, 0] = turns @ torch.diag_embed(spread.rsqrt()) @ turns.mT
    correlation = torch.tensor([[1.0, 0.7, -0.4], [0.7, 1.0, 0.1], [-0.4, 0.1, 1.0]]).double()
    maps.agreement[1, 0, 0] = torch.linalg.inv(correlation)
    seen = torch.cat([frames.features(states[:, None]), torch.ones(20, 1).double()], dim=-1)
    expected = []
    for row in range(20):
        roots, told = [], []  # of the covariances in the world, and what the frames say
        for frame, pose in enumerate([None, CUP, SHELF]):
            columns = [] if pose is None else [STATE.index(name) for name in pose]
            place = states[row, columns[:3]] if columns else torch.zeros(3).double()
            axes = (
                torch.from_numpy(rotations(states[row, columns[3:]]).as_matrix()) if columns else torch.eye(3).double()
            )
            roots.append(axes @ torch.linalg.inv(maps.whitening[frame, 1, 0, 0]) @ axes.T)
            told.append(axes @ (maps.weight[frame, 1, 0, :3] @ seen[row]) + place)
        covariance = (
            torch.block_diag(*roots) @ torch.kron(correlation, torch.eye(3).double()) @ torch.block_diag(*roots).T
        )
        inverse, ones = torch.linalg.inv(covariance), torch.eye(3).double().repeat(count, 1)
        expected.append(torch.linalg.solve(ones.T @ inverse @ ones, ones.T @ inverse @ torch.cat(told)))
    maps, frames = maps.to(dtype), frames.to(dtype)
    given = states[:, None].to(dtype)
    action = maps(frames.features(given), torch.ones(20, dtype=torch.long), frames, frames.origins(given))[:, 0]
    tolerance = 1e-4 if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(action[:, :3].double(), torch.stack(expected), atol=tolerance, rtol=0)


def test_frames_that_cannot_err_are_fused_all_the_same() -> None:
    """A hand that is always told to be in the middle of the cup: its frame has no error at all."""
    frames, states = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION).double(), scenes(50, 2)
    action = torch.cat([states[:, 7:14], states[:, -1:]], dim=-1)[:, None]
    maps, seen = FusedMaps(frames, 1, 1).double(), states[:, None]
    start, mask = torch.zeros(50, dtype=torch.long), torch.ones(50, 1, dtype=torch.bool)
    none = torch.zeros(frames.dim, frames.dim)
    maps.fit(frames.features(seen), start, frames, seen, action, mask, LEAST, False, none, SHRINKAGE)
    test = scenes(20, 3)
    given = test[:, None]
    told = maps(frames.features(given), torch.zeros(20, dtype=torch.long), frames, frames.origins(given))[:, 0]
    torch.testing.assert_close(told[:, :3], test[:, 7:10], atol=1e-3, rtol=0)


def test_what_is_seen_three_times_counts_once() -> None:
    """Where nothing moves, means show what the present state shows: frames that say the same do not outvote another."""
    draw, count = generator(60), 300
    states = scenes(count, 2)
    target = at_cup(states)
    target[:, :3] = 0.6 * target[:, :3] + 0.4 * states[:, 14:17] + 0.02 * torch.randn(count, 3, generator=draw)
    action = torch.cat([target, states[:, -1:]], dim=-1)[:, None]
    start, mask, test = torch.zeros(count, dtype=torch.long), torch.ones(count, 1, dtype=torch.bool), scenes(50, 3)

    def predictions(views: int, shrinkage: float) -> Tensor:
        frames = ObjectFrames(STATE, [*CUP, *SHELF, "cup.size"], ACTION, views).double()
        maps, seen, given = FusedMaps(frames, 1, 1).double(), states[:, None].expand(-1, views, -1), test[:, None]
        given = given.expand(-1, views, -1)
        none = torch.zeros(frames.dim, frames.dim)
        ridges = [(1.0, 30.0, 3000.0)]
        maps.fit(frames.features(seen), start, frames, seen, action, mask, ridges, False, none, shrinkage)
        return maps(frames.features(given), torch.zeros(50, dtype=torch.long), frames, frames.origins(given))[:, 0, :3]

    together, apart = (
        (predictions(3, shrinkage) - predictions(1, shrinkage)).norm(dim=-1).mean() for shrinkage in (1e-3, 1.0)
    )
    assert together < 0.2 * apart


@pytest.mark.parametrize("shrinkage", [0.0, 1.1, float("nan")])
def test_correlations_are_shrunk_by_a_share(shrinkage: float) -> None:
    with pytest.raises(ValueError, match=r"^policy\.fusion_shrinkage must be above 0 and at most 1, got "):
        HDRILConfig(device="cpu", push_to_hub=False, fusion_shrinkage=shrinkage)


def test_the_fit_takes_the_shrinkage_of_the_option(metadata) -> None:
    alone, together = (build(metadata, preset="hdril_reactive", hidden_dim=32, fusion_shrinkage=s) for s in (1.0, 0.2))
    identity = torch.eye(alone.fused[0].agreement.shape[-1])
    assert (alone.fused[0].agreement - identity).abs().max() < 1e-5
    assert (together.fused[0].agreement - identity).abs().max() > 1e-2


def test_a_fused_policy_says_what_it_needs(metadata) -> None:
    for values in ({"replan_every": 0}, {"rollout": "open_loop"}, {"state_skip": False}):
        with pytest.raises(
            ValueError,
            match=r"^policy\.coordinates=fused needs policy\.state_skip=true, .*; or give policy\.coordinates=absolute$",
        ):
            HDRILConfig(device="cpu", push_to_hub=False, **values)
    with pytest.raises(
        ValueError, match=r"^policy\.coordinates=fused needs poses of objects and .* policy\.preset=hdril needs none$"
    ):
        ObjectFrames(STATE, [], ACTION)
    plain: dict[str, Any] = {"device": "cpu", "push_to_hub": False, "coordinates": "absolute", "state_skip": False}
    for name in ("filter_frames", "long_filter_frames"):
        with pytest.raises(
            ValueError, match=rf"^policy\.{name} is for policy\.state_skip=true; got 8 and state_skip=false$"
        ):
            HDRILConfig(**plain, **{name: 8})
        with pytest.raises(ValueError, match=rf"^policy\.{name} must be at least 1, got 0$"):
            HDRILConfig(device="cpu", push_to_hub=False, **{name: 0})
    assert HDRILConfig(**plain).filters == []
    with pytest.raises(
        ValueError, match=r"^policy\.decoder=ode is integrated over a plan, and policy\.coordinates=fused "
    ):
        HDRILConfig(device="cpu", push_to_hub=False, decoder="ode")


@pytest.mark.parametrize("overlap", [0, 1, 2])
def test_a_fused_plan_reaches_as_far_as_it_acts_and_overlaps(metadata, overlap: int) -> None:
    policy = build(metadata, coordinates="fused", replan_every=2, plan_overlap=overlap).eval()
    seen = observation(metadata, [0, FRAMES])
    with pytest.raises(
        RuntimeError, match=r"^with policy\.coordinates=fused, predict_action_chunk .* policy\.preset=hdril$"
    ):
        policy.predict_action_chunk(seen)
    for left in (1, 2, 1):
        policy.select_action(seen)
        assert policy.predict_action_chunk(seen).shape == (2, left + overlap, 16)


def test_what_is_between_two_plans_is_a_pose_whatever_the_quaternions_signs(metadata) -> None:
    policy = build(metadata, coordinates="fused", replan_every=2, plan_overlap=1)
    old, new = (turned(3, 0.3, generator(seed)).float() for seed in (1, 2))
    hands = quaternion_groups(policy.config.action_names)
    plans = []
    for sign, quaternion in ((1.0, old), (-1.0, new)):
        plan = torch.zeros(3, 2, len(policy.loss_weights))
        plan[..., hands] = sign * quaternion[:, None, None]
        plan[..., 0] = float(len(plans))
        plans.append(plan)
    between = policy.fade(*plans, torch.tensor([[0.25], [0.75]]))
    for step, share in enumerate((0.25, 0.75)):
        assert (between[:, step, 0] == share).all()
        turn = share * (rotations(old).inv() * rotations(new)).as_rotvec()
        for columns in hands:
            told = between[:, step, columns]
            far = rotations(told) * (rotations(old) * Rotation.from_rotvec(turn)).inv()
            assert far.magnitude().max() < 2e-3
            torch.testing.assert_close(told.norm(dim=-1), torch.ones(3))


# ---------------------------------------------------------------------- noise of the hands


def test_noise_moves_the_hands_alone_and_all_states_alike() -> None:
    told = [f"{side}_{name}" for side in ("left", "right") for name in ["gripper.pos", *(f"ee.{a}" for a in POSE)]]
    names = [*told, "left_elbow.angle"]  # no action tells it
    openings, places, turns = [0, 8], [1, 2, 3, 9, 10, 11], [[4, 5, 6, 7], [12, 13, 14, 15]]
    states = torch.rand(20_000, 23, generator=generator(5))
    for columns in turns:
        states[:, columns] = turned(20_000, 1.0, generator(6)).float()
    std = torch.linspace(0.1, 1.0, 23)
    one, same = HandNoise(names, told, 0.01)(torch.stack([states, states], dim=1), std, generator()).unbind(1)
    assert torch.equal(one, same)
    assert torch.equal(one[:, 16:], states[:, 16:])
    moved = (one - states)[:, [*openings, *places]]
    angles = []
    for columns in turns:
        torch.testing.assert_close(one[:, columns].norm(dim=-1), torch.ones(20_000))
        far = rotations(one[:, columns]) * rotations(states[:, columns]).inv()
        angles.append(torch.from_numpy(far.as_rotvec()).float())
    everything = torch.cat([moved, *angles], dim=-1)
    deviations = torch.cat([REST * std[openings], torch.full((6,), 0.01), torch.full((6,), 0.01 * ANGLE)])
    torch.testing.assert_close(everything.std(0) / deviations, torch.ones(14), atol=0.03, rtol=0)
    assert (everything.mean(0) / deviations).abs().max() < 0.03
    assert (torch.corrcoef(everything.T) - torch.eye(14)).abs().max() < 0.04  # a draw of its own for each


def following(noise: float) -> tuple[FusedMaps, Tensor, Tensor, Tensor]:
    """Maps that bear noise of the hand, which is nearly where it is told to be: beside the cup, which is seen with errors.

    With them, what was seen, the hand's pose in the action, and the covariance of the noise."""
    frames, draw = ObjectFrames([*STATE, "left_gripper.pos"], [*CUP, *SHELF, "cup.size"], ACTION).double(), generator(6)
    maps, states = FusedMaps(frames, 1, 1).double(), scenes(400, 2)
    target = at_cup(states)
    opening = 1.0 + 1e-3 * torch.randn(400, 1, generator=draw).double()
    action = torch.cat([target, 1.0 + 2.0 * (opening - 1.0)], dim=-1)[:, None]
    states[:, :7] = target + 1e-3 * torch.randn(400, 7, generator=draw).double()
    states[:, 7:10] += 5e-3 * torch.randn(400, 3, generator=draw).double()
    states = torch.cat([states, opening], dim=-1)
    deviations = torch.zeros(frames.dim).double()
    deviations[:7], deviations[22] = noise, 20.0 * noise
    start, mask = torch.zeros(400, dtype=torch.long), torch.ones(400, 1, dtype=torch.bool)
    seen, covariance = frames.features(states[:, None]), torch.diag(deviations.square())
    seen[:, 23:] = 0.0  # the world's coordinates alone, so that one number is one way to follow
    maps.fit(seen, start, frames, states[:, None], action, mask, LEAST, False, covariance, SHRINKAGE)
    return maps, seen, target, covariance


def test_maps_that_bear_noise_do_not_follow_the_hand() -> None:
    plain, noisy = following(0.0)[0], following(0.02)[0]
    gains = [maps.weight[0, 0, 0, :3, :3].diagonal().abs() for maps in (plain, noisy)]
    assert gains[0].min() > 0.5  # the hand says better than the cup where it is told to go
    assert (gains[1] < 0.5 * gains[0]).all()
    assert plain.plain[0, 0, 0, 22] > 1.5  # and its opening runs away from itself
    assert noisy.plain[0, 0, 0, 22].abs() < 0.1


def test_a_frame_is_as_uncertain_as_its_errors_and_the_noise_make_it() -> None:
    maps, seen, target, covariance = following(0.02)
    x, noise = torch.cat([seen, torch.ones(400, 1).double()], dim=-1), F.pad(covariance, (0, 1, 0, 1))
    weight, errors = solve_ridge(x, target, ridge_penalty(x, 1e-6) + 400 * noise)
    second = errors.T @ errors / 400 + weight @ noise @ weight.T
    torch.testing.assert_close(maps.weight[0, 0, 0], weight)
    root = maps.whitening[0, 0, 0, 0]
    torch.testing.assert_close(torch.linalg.inv(root @ root), second[:3, :3] + 1e-7 * torch.eye(3))
    torch.testing.assert_close(maps.variance[0, 0, 0, 0], second[3:, 3:].trace() + 1e-7)


@pytest.mark.parametrize("dropout", [0.0, 0.2])
def test_noise_disturbs_training_alone(dropout: float, metadata) -> None:
    """By what the batch decides: not by how often the generator of PyTorch was asked before."""
    policy, quiet = (build(metadata, preset="hdril_reactive", hidden_dim=32, planner_dropout=dropout) for _ in range(2))
    quiet.hand_noise = None
    quiet.load_state_dict(policy.state_dict())

    def losses(training: bool) -> list[float]:
        with torch.no_grad():
            return [p.train(training).forward({"index": BATCH})[1]["dynamics_loss"] for p in (policy, policy, quiet)]

    before = torch.get_rng_state()
    noisy, again, without = losses(training=True)
    assert noisy == again != without
    assert len(set(losses(training=False))) == 1
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(
    "values",
    [
        {"per_primitive": False},
        {"latent": "variational", "samples": 2},
        {"interaction": "scalar", "planner_scale": 0.0},
    ],
)
def test_the_defaults_with_another_value_learn_and_act(values: dict[str, Any], metadata, tmp_path: Path) -> None:
    policy = build(metadata, **PRESETS["network_reactive"] | values)
    policy.train().forward({"index": BATCH})[0].backward()
    policy.eval().save_pretrained(tmp_path)
    loaded = HDRILPolicy.from_pretrained(tmp_path)
    for frame in range(3):
        seen = observation(metadata, [frame])
        assert torch.equal(loaded.select_action(seen), policy.select_action(seen))


@pytest.mark.parametrize(
    "override", ["--rollout=open_loop", "--replan_every=0", "--replan_every=1", "--replan_every=4"]
)
def test_a_trained_fused_policy_looks_as_it_learned(override: str, metadata, tmp_path: Path) -> None:
    build(metadata, preset="hdril_reactive").save_pretrained(tmp_path)
    with pytest.raises((ValueError, ParsingError)) as raised:
        HDRILPolicy.from_pretrained(tmp_path, config=HDRILConfig.from_pretrained(tmp_path, cli_overrides=[override]))
    told = str(raised.value.__cause__ or raised.value)  # draccus wraps what a config says of itself
    assert re.match(r"policy\.(coordinates=fused needs .*; train with|replan_every must be 2, because)", told), told


def test_noise_spares_what_no_action_tells(metadata) -> None:
    """A policy gives the noise the names of both."""
    policy = build(metadata, preset="hdril_reactive")
    assert policy.hand_noise is not None
    states, actions = policy.config.state_names, policy.config.action_names
    assert [states[i] for i in policy.hand_noise.rest] == ["left_gripper.pos", "right_gripper.pos"]
    policy.config.action_names = [name for name in actions if name != "left_gripper.pos"]
    policy._build()
    assert policy.hand_noise is not None
    assert [states[i] for i in policy.hand_noise.rest] == ["right_gripper.pos"]


def test_the_fit_bears_the_noise_that_the_option_asks_for(metadata) -> None:
    quiet, noisy, again = (
        build(metadata, preset="hdril_reactive", hidden_dim=32, **values) for values in ({"hand_noise": 0.0}, {}, {})
    )
    for maps, others in zip(noisy.fused, again.fused, strict=True):
        assert torch.equal(maps.weight, others.weight)
    assert not torch.equal(noisy.fused[0].weight, quiet.fused[0].weight)
    assert quiet.state_dict().keys() == noisy.state_dict().keys()
    data = demonstrations(noisy)
    window = data.window(data.replan_rows(1, torch.ones(6, dtype=torch.bool)), 1, 1)
    window = replace(window, seen=window.seen.double())
    covariance = noise_covariance(noisy, window, noisy.features(window.seen)[0])
    place = noisy.config.state_names.index("left_ee.x")
    # Of the present state, and of the means of the last ones.
    for column in place + len(noisy.state_std) * torch.arange(3):
        expected = (0.005 / noisy.feature_std[place].double()) ** 2
        torch.testing.assert_close(covariance[column, column], expected, rtol=0.15, atol=0)
    table = noisy.config.environment_names.index("table.x") + len(noisy.config.state_names)
    assert covariance[table, table] == 0.0


@pytest.mark.parametrize("values", [{"hand_noise": -0.01}, {"hand_noise": 0.01, "coordinates": "absolute"}])
def test_noise_is_for_maps_that_are_fused(values: dict[str, Any]) -> None:
    with pytest.raises(
        ValueError, match=r"^policy\.hand_noise must not be negative, and is for policy\.coordinates=fused"
    ):
        HDRILConfig(device="cpu", push_to_hub=False, **values)
    for coordinates in ("absolute", "relational"):
        assert HDRILConfig(device="cpu", push_to_hub=False, coordinates=coordinates).hand_noise == 0.0
