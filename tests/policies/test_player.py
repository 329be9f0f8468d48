"""Which primitive plays: rules of playing, with a policy whose wishes and plans are known."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot_policy_hdril import HDRILPolicy
from lerobot_policy_hdril.player import Choice, PlaybackState, advance

from tests.policies.tools import BATCH, FRAMES, STARTS, Training, build, edit, observation, read

SHORTEST, LONGEST = [3, 2, 4], [5, 6, 4]


class Scripted:
    """A policy of three primitives that wants what it is told, row by row, and plans 100 k + (frame of the primitive), and
    1000 times the frame at which it plans if its plans are to differ."""

    apart = 0

    def __init__(self, wishes: list[list[int]], **config) -> None:
        self.config = SimpleNamespace(
            **{"rollout": "closed_loop", "replan_every": 0, "plan_overlap": 0, "filters": []}
            | {"least_survival": 0.0, "repeat_discount": 0.0}
            | config
        )
        self.shortest_length, self.longest_length = torch.tensor(SHORTEST), torch.tensor(LONGEST)
        self.alike = torch.eye(3, dtype=torch.bool)
        self.wishes, self.planned_from, self.means = iter(wishes), [], []

    def choose(self, state, previous):
        begin = torch.nn.functional.one_hot(torch.tensor(next(self.wishes)), 3).float()
        return Choice(begin, None, torch.zeros(1, len(state), 1))

    def plan(self, seen, primitive, elapsed):
        self.planned_from.append((seen[:, 0, 0].tolist(), primitive.tolist(), elapsed.tolist()))
        self.means.append(seen[:, 1:, 0].tolist())
        steps = 100 * primitive[:, None] + elapsed[:, None] + torch.arange(6) + self.apart * seen[:, 0, :1]
        # One action, and one number of state.
        return torch.stack([steps, steps + 0.5], dim=-1)

    def fade(self, old, new, share):
        return old.lerp(new, share)


def play(policy: Any, frames: int, rows: int = 1) -> list[PlaybackState]:
    """``policy`` has what :func:`advance` asks of an HDRILPolicy."""
    states, state = [], None
    for t in range(frames):
        state = advance(policy, state, torch.full((rows, 1), float(t)))
        states.append(state)
    return states


def played(policy: Scripted, frames: int, row: int = 0, rows: int = 1) -> list[tuple[int, int]]:
    return [(int(s.primitive[row]), int(s.elapsed[row])) for s in play(policy, frames, rows)]


def test_primitive_ends_at_its_shortest_length_if_another_is_preferred() -> None:
    wishes = [[0], [1], [1], [1], [1], [0], [0]]
    assert played(Scripted(wishes), 7) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (0, 0), (0, 1)]


def test_primitive_plays_to_its_longest_length_if_it_is_preferred_and_may_play_again() -> None:
    assert played(Scripted([[0]] * 7), 7) == [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (0, 0), (0, 1)]


def test_wish_in_between_is_followed_at_once() -> None:
    wishes = [[0]] * 4 + [[2]] * 5
    assert played(Scripted(wishes), 9)[3:] == [(0, 3), (2, 0), (2, 1), (2, 2), (2, 3), (2, 0)]


def test_rows_of_a_batch_play_by_themselves() -> None:
    wishes = [[0, 2], [1, 1], [1, 1], [1, 1], [1, 1], [0, 0]]
    assert played(Scripted(wishes), 6, 0, 2) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (0, 0)]
    assert played(Scripted(wishes), 6, 1, 2) == [(2, 0), (2, 1), (2, 2), (2, 3), (1, 0), (1, 1)]


def test_actions_are_those_of_the_plan() -> None:
    wishes = [[0], [1], [1], [1], [1], [0], [0]]
    states = play(Scripted(wishes), 7)
    assert [s.row()[0, 0].item() for s in states] == [0, 1, 2, 100, 101, 0, 1]


@pytest.mark.parametrize(("every", "due"), [(0, [0, 3]), (2, [0, 2, 3, 5]), (1, [0, 1, 2, 3, 4, 5])])
def test_plans_are_made_at_starts_and_every_so_many_frames(every: int, due: list[int]) -> None:
    policy = Scripted([[0], [0], [0], [1], [1], [1]], replan_every=every)
    states = play(policy, 6)
    assert [t for t, s in enumerate(states) if s.replanned[0]] == due
    assert [state[0] for state, _, _ in policy.planned_from] == due
    assert [s.row()[0, 0].item() for s in states] == [0, 1, 2, 100, 101, 102]


class Fading(Scripted):
    """Its plans reach no further than the overlap, as those of the fused maps do."""

    apart = 1000

    def plan(self, seen, primitive, elapsed):
        return super().plan(seen, primitive, elapsed)[:, : self.config.replan_every + self.config.plan_overlap]


@pytest.mark.parametrize(
    ("overlap", "expected"),
    [
        (0, [0, 1, 2002, 2003, 4100, 4101, 6102, 6103]),
        (1, [0, 1, 1002, 2003, 4100, 4101, 5102, 6103]),
        (2, [0, 1, 2 + 2000 / 3, 3 + 4000 / 3, 4100, 4101, 4102 + 2000 / 3, 4103 + 4000 / 3]),
    ],
)
def test_plans_fade_into_each_other_within_a_primitive_alone(overlap: int, expected: list[float]) -> None:
    policy = Fading([[0], [0], [0], [0], [1], [1], [1], [1]], replan_every=2, plan_overlap=overlap)
    told = [s.row()[0, 0].item() for s in play(policy, 8)]
    assert told == pytest.approx(expected)


@pytest.mark.parametrize(
    ("wishes", "expected"),
    [
        (
            [[0, 2]] * 3 + [[1, 2]] + [[1, 1]] * 3,
            [(0, 1, 1002, 3100, 3101, 4102, 5103), (200, 201, 1202, 2203, 4100, 4101, 5102)],
        ),
        # At the fifth frame the one row begins, and the plan of the other is made anew.
        ([[0, 1]] * 4 + [[1, 1]] * 2, [(0, 1, 1002, 2003, 4100, 4101), (100, 101, 1102, 2103, 3104, 4105)]),
    ],
)
def test_rows_of_a_batch_fade_by_themselves(wishes: list[list[int]], expected: list[tuple[float, ...]]) -> None:
    states = play(Fading(wishes, replan_every=2, plan_overlap=1), len(wishes), 2)
    assert list(zip(*(s.row()[:, 0].tolist() for s in states), strict=True)) == expected


def test_open_loop_goes_on_from_the_predicted_state() -> None:
    policy = Scripted([[0]] * 3 + [[1]] * 3, rollout="open_loop")
    states = play(policy, 6)
    # The first state is seen; then each is what the plan said of the frame before.
    assert [s.state[0, 0].item() for s in states] == [0.0, 0.5, 1.5, 2.5, 100.5, 101.5]
    assert policy.planned_from[1] == ([2.5], [1], [0])


def test_rest_of_a_plan_ends_with_the_longest_form() -> None:
    states = play(Scripted([[0, 2]] * 2), 2, 2)
    lengths = torch.tensor(LONGEST)
    assert states[1].select(0).rest(lengths)[0, :, 0].tolist() == [1, 2, 3, 4]
    assert states[1].rest(lengths)[..., 0].tolist() == [[1, 2, 3, 4], [201, 202, 203, 203]]


# ---------------------------------------------------------------------- the policy itself


@pytest.fixture(scope="module")
def trained(metadata) -> HDRILPolicy:
    """A policy whose planner knows the demonstrations."""
    training = Training(build(metadata, planner_batch_size=6), 60)
    for _ in range(60):
        training.step(BATCH)
    return training.policy.eval()


def test_chunk_is_what_select_action_gives_and_changes_nothing(metadata, trained: HDRILPolicy) -> None:
    trained.reset()
    straight = [trained.select_action(observation(metadata, [t, FRAMES + t])) for t in range(30)]
    trained.reset()
    for t, action in enumerate(straight):
        seen = observation(metadata, [t, FRAMES + t])
        chunks = [trained.predict_action_chunk(seen) for _ in range(2)]
        assert torch.equal(*chunks)
        assert torch.equal(chunks[0][:, 0], action)
        assert torch.equal(trained.select_action(seen), action)


def test_chunks_alone_go_through_the_primitives(metadata, trained: HDRILPolicy) -> None:
    """As LeRobot's asynchronous server has it: ask for a chunk, play all of it, ask again. Nothing else is called."""
    trained.reset()
    for episode in range(6):
        frame, starts = 0, []
        while frame < FRAMES:
            starts.append(frame)
            frame += trained.predict_action_chunk(observation(metadata, [episode * FRAMES + frame])).shape[1]
        assert starts == STARTS


def test_chunk_of_a_batch_repeats_the_last_action(metadata, trained: HDRILPolicy) -> None:
    trained.reset()
    frames = [0, STARTS[1]]  # grasp has 10 frames, move 12
    both = trained.predict_action_chunk(observation(metadata, frames))
    assert both.shape[:2] == (2, 12)
    assert torch.equal(both[0, 10:], both[0, 9].expand(2, -1))
    for row, frame in enumerate(frames):
        alone = trained.predict_action_chunk(observation(metadata, [frame]))
        torch.testing.assert_close(both[row, : alone.shape[1]], alone[0], atol=1e-5, rtol=1e-4)


def test_primitives_of_varying_length_are_played_within_their_lengths(varied, monkeypatch) -> None:
    policy = build(varied).eval()
    lengths = policy.config.primitive_lengths
    assert any(low < high for low, high in lengths)

    # A planner that never agrees with what plays: each primitive ends at its shortest length.
    def choose(state, previous):
        count = 0 if previous is None else int(previous.memory.item()) + 1
        return Choice(torch.eye(6)[count % 2][None], None, torch.full((1, 1, 1), float(count)))

    monkeypatch.setattr(policy, "choose", choose)
    runs: list[list] = []
    for t in range(40):
        policy.select_action(observation(varied, [t]))
        told = policy.explain()
        assert told is not None
        if told.plan is not None:
            runs.append([told.primitive, 0])
        runs[-1][1] += 1
    for name, length in runs[:-1]:
        low, high = lengths[policy.config.primitives.index(name)]
        assert low <= length <= high


def test_a_run_that_the_episode_cuts_is_no_shortest_one(copy: Path) -> None:
    """The last primitive also plays in the middle of one episode, for nine frames. The end of another leaves one frame of it."""

    def label(episode: int, frame: int, value: int) -> int:
        if episode == 0:
            return 5 if 36 <= frame < 45 else min(value, 4)
        return min(value, 4) if episode == 1 and frame < FRAMES - 1 else value

    edit(copy, "subtask_index", label)
    edit(copy, "subtask_start", lambda episode, frame, value: value or (episode == 0 and frame in (36, 45)))
    assert build(read(copy)).config.primitive_lengths[5] == [9, FRAMES - STARTS[-1]]


def test_a_primitive_that_only_ends_episodes_has_the_lengths_of_its_last_runs(varied) -> None:
    # `vary_lengths` begins the last primitive up to three frames later.
    last = [FRAMES - STARTS[-1] - (episode + 10) % 4 for episode in range(6)]
    assert build(varied).config.primitive_lengths[5] == [min(last), max(last)]


def test_open_loop_does_not_look(metadata) -> None:
    policy = build(metadata, rollout="open_loop").eval()
    first = [policy.select_action(observation(metadata, [t])) for t in range(30)]
    policy.reset()
    blind = [policy.select_action(observation(metadata, [0])) for _ in range(30)]
    assert torch.equal(torch.stack(first), torch.stack(blind))
    looking = build(metadata, rollout="closed_loop").eval()
    seeing = [looking.select_action(observation(metadata, [t])) for t in range(30)]
    assert not torch.allclose(torch.stack(seeing), torch.stack(blind))
