"""The simulator behind a world: which links collide, and what a client that held another world leaves behind."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hdril.demonstrations.provenance import Recipe
from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.rollout import run_episode
from hdril.simulation import world as simulator
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.world import World
from hdril.trace import trace_episode

SPHERE = '<geometry><sphere radius="0.1"/></geometry>'


@pytest.fixture
def world() -> Iterator[World]:
    with closing(World()) as made:
        yield made


def _spheres(folder: Path, count: int) -> Path:
    """Spheres that overlap: links of one body, each on a joint of its own."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "\n".join(f'<link name="s{i}">{inertial}<collision>{SPHERE}</collision></link>' for i in range(count))
    joints = "\n".join(
        f'<joint name="j{i}" type="prismatic"><parent link="base"/><child link="s{i}"/><origin xyz="{0.005 * i} 0 0"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for i in range(count)
    )
    path = folder / f"spheres-{count}.urdf"
    path.write_text(f'<robot name="spheres"><link name="base">{inertial}</link>{links}\n{joints}</robot>')
    return path


def _touching(world: World, body: str) -> set[frozenset[str]]:
    return {frozenset((contact.link_a, contact.link_b)) for contact in world.contacts(body, body)}


def _some(pairs: list[tuple[str, str]]) -> list[tuple[str, str]]:
    rng = np.random.default_rng(5)
    return [pair for pair in pairs if rng.uniform() < 0.4]


@pytest.mark.parametrize("count", [4, 12, 24, 25, 28])  # of 24 links and a base, each can have a bit of its own
def test_links_collide_unless_their_pair_is_ignored(world: World, tmp_path: Path, count: int) -> None:
    pairs = list(combinations([f"s{i}" for i in range(count)], 2))
    # Each link of a ring ignores others than the next one does, so that no two of them can share a filter.
    ignored = _some(pairs) if count <= 12 else [(f"s{i}", f"s{(i + 1) % count}") for i in range(count)]
    world.add_urdf("spheres", _spheres(tmp_path, count), Pose((0.0, 0.0, 1.0)), self_collision=True)
    world.ignore_collisions("spheres", ignored)
    world.step()
    assert _touching(world, "spheres") == set(map(frozenset, pairs)) - set(map(frozenset, ignored))


def test_what_is_ignored_later_adds_to_what_was(world: World, tmp_path: Path) -> None:
    world.add_urdf("spheres", _spheres(tmp_path, 4), Pose((0.0, 0.0, 1.0)), self_collision=True)
    world.ignore_collisions("spheres", [("s0", "s1")])
    world.ignore_collisions("spheres", [("s1", "s2"), ("s3", "s0")])
    world.step()
    assert _touching(world, "spheres") == set(map(frozenset, [("s0", "s2"), ("s1", "s3"), ("s2", "s3")]))


def test_a_second_body_has_filters_of_its_own(world: World, tmp_path: Path) -> None:
    path, at = _spheres(tmp_path, 3), Pose((0.0, 0.0, 1.0))
    for name in ("first", "second"):
        world.add_urdf(name, path, at, self_collision=True)
        world.ignore_collisions(name, [("s0", "s1"), ("s1", "s2"), ("s0", "s2")])
    world.step()
    assert not _touching(world, "first")
    assert not _touching(world, "second")
    assert len(world.contacts("first", "second")) >= 9


def test_links_with_filters_touch_what_stands_in_the_world(world: World, tmp_path: Path) -> None:
    path = _spheres(tmp_path, 2)
    path.write_text(
        path.read_text().replace('<link name="base">', f'<link name="base"><collision>{SPHERE}</collision>')
    )
    world.add_urdf("spheres", path, Pose((0.0, 0.0, 1.0)), self_collision=True)
    world.ignore_collisions("spheres", [("s0", "s1"), ("base", "s0"), ("base", "s1")])
    world.add_body(BodySpec("floor", (Box((1.0, 1.0, 0.1), (0.0, 0.0, 0.0)),)), Pose((0.0, 0.0, 0.86)))
    world.add_body(BodySpec("block", (Box((0.1, 0.1, 0.1), (0.0, 0.0, 0.0)),), mass=1.0), Pose((0.0, 0.0, 1.14)))
    world.step()
    for body, links in (("floor", {"s0", "s1"}), ("block", {"base", "s0", "s1"})):  # a fixed base touches what can move
        assert {contact.link_a for contact in world.contacts("spheres", body)} == links


def test_a_file_that_changed_is_read_anew(tmp_path: Path) -> None:
    for count in (2, 3):
        path = _spheres(tmp_path, count).rename(tmp_path / "robot.urdf")
        with closing(World()) as made:
            made.add_urdf("spheres", path, Pose((0.0, 0.0, 1.0)))
            assert made.links("spheres") == ("base", *(f"s{i}" for i in range(count)))


def test_one_client_at_most_waits_for_the_next_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator, "_idle", [])
    worlds = [World() for _ in range(3)]
    for made in worlds:
        made.close()
        made.close()
        assert len(simulator._idle) == 1


def test_an_unknown_link_cannot_be_ignored(world: World, tmp_path: Path) -> None:
    world.add_urdf("spheres", _spheres(tmp_path, 2), Pose((0.0, 0.0, 1.0)))
    with pytest.raises(KeyError, match="spheres has no link 'elbow'; links: base, s0, s1"):
        world.ignore_collisions("spheres", [("s0", "elbow")])


def _states(task: str, seed: int) -> NDArray[np.float64]:
    recipe = Recipe(task)
    with closing(recipe.make_env()) as env:
        trace, ending = trace_episode(env, recipe.make_expert(), seed)
        assert ending.success
        return np.concatenate([trace.state.ravel(), env.world.state_vector()])


def test_an_episode_is_the_same_whatever_world_its_client_held_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator, "_idle", [])
    alone = _states("table_lift", 3)
    for before, seed in (("peg_in_hole", 1), ("table_lift:level=hard", 2)):
        recipe = Recipe(before)
        env, expert = recipe.make_env(), recipe.make_expert()
        run_episode(env, expert, seed)
        env.close()
        assert len(simulator._idle) == 1
        np.testing.assert_array_equal(_states("table_lift", 3), alone)


def test_worlds_that_are_open_together_do_not_share_a_client() -> None:
    with closing(BimanualEnv("table_lift")) as one, closing(BimanualEnv("table_lift")) as other:
        for env, seed in ((one, 0), (other, 1)):
            env.reset(seed=seed)
        before = one.world.state_vector()
        other.world.step(24)
        np.testing.assert_array_equal(one.world.state_vector(), before)


def test_a_world_reads_poses_anew_after_a_step(world: World) -> None:
    world.add_body(BodySpec("block", (Box((0.1, 0.1, 0.1), (0.0, 0.0, 0.0)),), mass=1.0), Pose((0.0, 0.0, 1.0)))
    heights = []
    for _ in range(3):
        assert world.pose("block") is world.pose("block")
        heights.append(float(world.pose("block").position[2]))
        world.step(10)
    assert heights[0] > heights[1] > heights[2]
