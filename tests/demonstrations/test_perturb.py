"""Demonstrations with a disturbed robot: what is recorded, what is sent, and that they can be made again."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from hdril.actor import Decision, Observation
from hdril.demonstrations.episode import demonstrate
from hdril.demonstrations.perturb import PerturbedActor
from hdril.demonstrations.provenance import Recipe
from hdril.rollout import transitions
from hdril.simulation.actions import hand_poses, hand_slice, openings
from hdril.tasks import get_task
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.tasks.scenario import Scenario

OBSERVATION: Observation = {}


class Still:
    """Always answers with the same action; its hands are open or closed."""

    def __init__(self, opening: float) -> None:
        self.action = np.zeros(16)
        for side in ("left", "right"):
            self.action[hand_slice(side)][6:] = 1.0, opening

    def reset(self, seed: int) -> None:
        pass

    def act(self, observation: Observation) -> Decision:
        return Decision(self.action)


def offsets(opening: float, deviation: float, seed: int = 0, frames: int = 2000, stray: float = 0.0) -> np.ndarray:
    """What is sent less what was meant (T, 2, 3), m."""
    actor = PerturbedActor(Still(opening), deviation, stray)
    actor.reset(seed)
    decisions = [actor.act(OBSERVATION) for _ in range(frames)]
    meant, sent = (np.stack(rows) for rows in zip(*((d.action, d.sent) for d in decisions), strict=True))
    np.testing.assert_array_equal(openings(meant), openings(sent))
    np.testing.assert_array_equal(hand_poses(meant)[..., 3:], hand_poses(sent)[..., 3:])
    return (hand_poses(sent) - hand_poses(meant))[..., :3]


def test_the_noise_has_the_deviation_that_was_asked_for() -> None:
    noise = offsets(1.0, 0.01)
    assert noise.std(axis=0) == pytest.approx(np.full((2, 3), 0.01), rel=0.1)
    assert np.abs(np.corrcoef(noise.reshape(len(noise), -1).T) - np.eye(6)).max() < 0.1
    np.testing.assert_array_equal(noise[:50], offsets(1.0, 0.01, frames=50))
    assert (noise[:50] != offsets(1.0, 0.01, seed=1, frames=50)).all()


def test_hands_that_may_hold_one_body_are_moved_alike() -> None:
    noise = offsets(0.0, 0.01, frames=100)
    np.testing.assert_allclose(noise[:, 0], noise[:, 1], atol=1e-12)
    assert noise.std() > 0.005


def test_now_and_then_a_hand_strays() -> None:
    """Each by itself, for 6 to 14 frames, in a share of the frames that the rate tells."""
    away = offsets(1.0, 0.0, stray=0.03, frames=20_000)
    np.testing.assert_array_equal(away[:300], offsets(1.0, 0.0, stray=0.03, frames=300))
    assert (away[:300] != offsets(1.0, 0.0, seed=1, stray=0.03, frames=300)).any()
    strays = np.abs(away).max(axis=2) > 0.0  # (T, 2)
    assert np.corrcoef(strays.T)[0, 1] == pytest.approx(0.0, abs=0.05)
    places = []
    for side in range(2):
        changes = np.flatnonzero((np.diff(away[:, side], axis=0, prepend=0.0) != 0.0).any(axis=1))
        runs = np.diff(changes)
        lengths = runs[strays[changes[:-1], side]]
        assert set(lengths) <= set(range(6, 15))
        assert {6, 14} <= set(lengths)
        places.append(away[changes[strays[changes, side]], side])
        assert strays[:, side].mean() == pytest.approx(10.0 / (10.0 + 49.0), rel=0.15)
    assert np.concatenate(places).std(axis=0) == pytest.approx(np.full(3, 0.03), rel=0.15)


def test_an_episode_does_not_hang_on_what_was_before_it() -> None:
    actor = PerturbedActor(Still(1.0), 0.0, 0.03)
    for frames in range(60):  # the last episode may end while a hand strays
        actor.reset(0)
        for _ in range(frames):
            actor.act(OBSERVATION)
        actor.reset(9)
        sent = np.stack([actor.act(OBSERVATION).sent for _ in range(20)])
        np.testing.assert_array_equal(hand_poses(sent)[..., :3], offsets(1.0, 0.0, seed=9, stray=0.03, frames=20))


def test_strays_join_the_noise_of_every_frame() -> None:
    noise, both = offsets(1.0, 0.01, frames=200), offsets(1.0, 0.01, stray=0.03, frames=200)
    np.testing.assert_allclose(both - noise, offsets(1.0, 0.0, stray=0.03, frames=200), atol=1e-12)


def test_hands_that_may_hold_one_body_stray_alike() -> None:
    away = offsets(0.0, 0.0, stray=0.03, frames=300)
    np.testing.assert_allclose(away[:, 0], away[:, 1], atol=1e-12)
    assert away.any()


@pytest.mark.parametrize(
    ("name", "deviation", "most"),
    [("perturb", -0.001, 0.03), ("perturb", 0.031, 0.03), ("stray", -0.1, 0.1), ("stray", 0.11, 0.1)],
)
def test_a_deviation_out_of_range_is_refused(name: str, deviation: float, most: float) -> None:
    with pytest.raises(ValueError, match=rf"^{name} must be from 0 to {most} m, got {deviation}$"):
        Recipe("table_lift", **{name: deviation})


def test_a_recipe_of_strays_alone_disturbs_the_robot() -> None:
    recipe = Recipe("table_lift", stray=0.05)
    assert recipe.perturbed
    env, expert = recipe.make_env(), recipe.make_expert()
    with closing(env):
        decisions = [transition.decision for transition in transitions(env, expert, 11)]
    apart = [np.abs(d.sent - d.action).max() if d.sent is not None else 0.0 for d in decisions]
    assert max(apart) > 0.02
    assert min(apart) == 0.0


@pytest.mark.parametrize("noise", [{"perturb": 0.005}, {"perturb": 0.005, "stray": 0.02}])
def test_the_robot_gets_the_noise_and_the_record_does_not(noise: dict[str, float]) -> None:
    recipe = Recipe("table_lift", Noise(0.0), **noise)
    env, expert = recipe.make_env(), recipe.make_expert()
    with closing(env):
        episode = demonstrate(env, expert, 11)
        again = demonstrate(env, recipe.make_expert(), 11)
        quiet = ScriptedExpert(get_task("table_lift"), Noise(0.0))
        undisturbed = demonstrate(env, quiet, 11)
        sent = np.stack([transition.decision.sent for transition in transitions(env, expert, 11)])
    np.testing.assert_array_equal(episode.action, again.action)
    np.testing.assert_array_equal(episode.state, again.state)
    # The first primitive is planned before anything is disturbed: its record is that of an undisturbed robot.
    np.testing.assert_array_equal(episode.action[:10], undisturbed.action[:10])
    apart = np.abs(hand_poses(sent) - hand_poses(episode.action))[..., :3]
    assert (apart.max(axis=(1, 2)) > 0).all()
    assert not np.allclose(episode.state[1:10], undisturbed.state[1:10], atol=1e-3)


def test_what_goes_wrong_is_in_the_record() -> None:
    """A demonstration of table lift with an opened hand: the scenario names it, and a repeated primitive starts again."""
    recipe = Recipe("table_lift:open_hand=1")
    env = recipe.make_env()
    with closing(env):
        episodes = [demonstrate(env, recipe.make_expert(), seed) for seed in range(4)]
    for seed, episode in enumerate(episodes):
        scenario = Scenario.from_json(episode.scenario)
        assert scenario == get_task(recipe.task).sample(seed)
        assert [event.name for event in scenario.events] == ["open_hand"]
        assert episode.start[0]
        changed = np.flatnonzero(np.diff(episode.label, prepend=-1))
        assert set(changed) <= set(np.flatnonzero(episode.start))
