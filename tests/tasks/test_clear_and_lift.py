"""What is particular to clear-and-lift: where the canister stands decides the plan, and the wrong plan fails."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.rollout import transitions
from hdril.simulation.world import World
from hdril.tasks import get_task
from hdril.tasks.clear_and_lift import ASIDE, ASIDE_NEED, BOX_ASIDE, CLEARANCE, EDGE, lowest
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.tasks.scenario import Scenario
from hdril.tasks.table_lift import DEPTH, PLATFORM_DEPTH, TOP, WIDTH

NAME = "clear_and_lift"
TASK = get_task(NAME)
TABLE_LIFT = tuple(primitive.name for primitive in get_task("table_lift").primitives)
PLACES = [(place, side) for place in ("table", "platform") for side in ("left", "right")]


def where(scenario: Scenario) -> tuple[str, str]:
    """What the canister stands on, and on which side."""
    _, y, z = scenario.pose("box").position
    return "bench" if z == 0.0 else "table" if z == TOP else "platform", "left" if y >= 0.0 else "right"


@cache
def seeds_of(place: str, side: str, level: str = "nominal") -> list[int]:
    """Seeds whose scenes have the canister there."""
    task = get_task(f"{NAME}:level={level}")
    return [seed for seed in range(980_000, 980_200) if where(task.sample(seed)) == (place, side)]


def seed_of(place: str, side: str) -> int:
    """A seed whose scene has the canister there."""
    return seeds_of(place, side)[0]


def play(
    seed: int, script: tuple[str, ...] = TASK.labels, level: str = "nominal", max_episode_steps: int | None = None
) -> tuple[dict, list[str], BimanualEnv]:
    """The last info of an episode, the primitives that were begun, and the world as it ends; of an expert that knows
    the primitives in ``script`` alone."""
    env = BimanualEnv(f"{NAME}:level={level}", max_episode_steps=max_episode_steps)
    chosen = tuple(
        p.needing(*(need for need in p.needs if need is not ASIDE_NEED)) if script == TABLE_LIFT else p
        for p in env.task_spec.primitives if p.name in script
    )  # fmt: skip
    expert, begun, info = ScriptedExpert(replace(env.task_spec, primitives=chosen), Noise(0.0)), [], {}
    for transition in transitions(env, expert, seed):
        info, explanation = transition.info, transition.decision.explanation
        if explanation is not None and explanation.starts:
            begun.append(expert.task.labels[explanation.primitive])
    return info, begun, env


def test_half_of_the_scenes_are_clear() -> None:
    counts = dict.fromkeys([*PLACES, ("bench", "left"), ("bench", "right")], 0)
    for seed in range(800):
        counts[where(TASK.sample(seed))] += 1
    aside = counts[("bench", "left")] + counts[("bench", "right")]
    assert aside == pytest.approx(400, abs=60)
    assert min(counts[key] for key in PLACES) > 60


@pytest.mark.parametrize("level", ["nominal", "varied"])
def test_the_canister_stands_on_what_it_should_and_in_nothing(level: str) -> None:
    task = get_task(f"{NAME}:level={level}")
    for seed in range(150):
        scenario = task.sample(seed)
        sizes = dict(task.at(scenario.values).attributes)
        box, table, platform = (scenario.pose(name) for name in ("box", "table", "platform"))
        x, y, _ = (table.inverse() @ box).position
        outside = np.maximum(np.abs((x, y)) - (sizes["table.depth"] / 2, sizes["table.length"] / 2), 0.0)
        match where(scenario)[0]:
            case "table":
                assert abs(x) < sizes["table.depth"] / 2 - EDGE / 2
                assert abs(y) < 0.42 * sizes["table.length"] - EDGE / 2
            case "platform":
                assert box.position[2] == pytest.approx(sizes["platform.height"])
                assert (
                    abs(box.position[0] - platform.position[0]) <= PLATFORM_DEPTH / 2 - EDGE / 2 + 0.01 + 1e-9
                )  # 1 cm may be over the edge
                assert np.hypot(*outside) >= CLEARANCE - 1e-9
            case _:
                assert np.hypot(*outside) > CLEARANCE


@pytest.mark.parametrize(("place", "side"), PLACES)
def test_the_nearer_hand_puts_the_canister_aside_first(place: str, side: str) -> None:
    info, begun, env = play(seed_of(place, side))
    with closing(env):
        assert info["is_success"], info
        assert begun == [f"pick_{side}", f"put_{side}", *TABLE_LIFT]
        x, y, _ = env.world.pose("box").position
        assert (x, abs(y)) == pytest.approx(ASIDE, abs=0.06)
        assert (y > 0.0) == (side == "left")


def test_a_success_that_comes_late_must_hold() -> None:
    with closing(BimanualEnv(NAME)) as env:
        steps = list(transitions(env, ScriptedExpert(TASK, Noise(0.0)), seed_of("table", "left")))
    held = [f"success has held for {frames} of {TASK.dwell} frames" for frames in range(1, TASK.dwell)]
    assert [step.info["unmet"] for step in steps[-TASK.dwell :]] == [*held, ""]
    assert not steps[-TASK.dwell - 1].info["unmet"].startswith("success")
    assert [step.terminated for step in steps[-2:]] == [False, True]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_canister_that_stands_aside_is_left_alone(side: str) -> None:
    seed = seed_of("bench", side)
    info, begun, env = play(seed)
    with closing(env):
        assert info["is_success"], info
        assert begun == list(TABLE_LIFT)
        assert env.frame == TASK.horizon
        drawn = TASK.sample(seed).pose("box").position
        assert env.world.pose("box").position == pytest.approx(drawn, abs=2e-3)


@pytest.mark.parametrize("level", ["nominal", "varied"])
@pytest.mark.parametrize(("place", "side"), PLACES)
def test_a_planner_that_skips_the_step_fails(place: str, side: str, level: str) -> None:
    """The canister stays on the table, or the table shoves it over the platform, or behind it, or off the bench."""
    for seed in seeds_of(place, side, level)[: 3 if level == "nominal" else 1]:
        info, begun, env = play(seed, TABLE_LIFT, level, max_episode_steps=TASK.horizon + 30)
        with closing(env):
            assert set(begun) <= set(TABLE_LIFT)
            assert not info["is_success"], seed


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_planner_that_adds_the_step_fails(side: str) -> None:
    """It succeeds with the table, but the canister is no longer where it stood; however long it may take."""
    pick, put = f"pick_{side}", f"put_{side}"
    unasked = tuple(
        p.needing() if p.name in (pick, put) else p for p in TASK.primitives if p.name in (pick, put, *TABLE_LIFT)
    )
    with closing(BimanualEnv(NAME, max_episode_steps=3 * TASK.budget)) as env:
        expert = ScriptedExpert(replace(TASK, primitives=unasked), Noise(0.0))
        steps = list(transitions(env, expert, seed_of("bench", side)))
        assert "box that stood aside left there" in steps[-1].info["unmet"]
        assert BOX_ASIDE.holds(env.world)


@pytest.mark.parametrize(
    ("turned", "expected"),
    [((0.0, 0.0, 0.0, 1.0), 0.0), ((1.0, 0.0, 0.0, 1.0), -EDGE / 2), ((1.0, 0.0, 0.0, 0.0), -0.35)],
)
def test_lowest_corner(turned: tuple[float, ...], expected: float) -> None:
    assert lowest(Pose((0.3, 0.2, 0.5), turned)) == pytest.approx(0.5 + expected)


def test_a_canister_counts_as_aside_on_the_bench_alone() -> None:
    """Standing against the platform, hanging in the air or lying behind the platform is not aside."""
    spec = {body.name: body for body in TASK.bodies}
    for box, expected in [
        ((0.5, 0.82, 0.0), True),
        ((0.5, 0.82, 0.2), False),
        ((1.20, 0.0, 0.0), False),
        ((0.98 - 0.15 - EDGE / 2 + 0.0005, 0.0, 0.0), False),
        ((0.98, 0.0, 0.12), False),
    ]:
        with closing(World()) as world:
            world.add_urdf("robot", BimanualEnv(NAME).robot_spec.urdf(False), Pose((-3.0, 0.0, 1.0)))
            world.add_body(spec["bench"], Pose((0.82, 0.0, 0.0)))
            world.add_body(spec["platform"], Pose((0.98, 0.0, 0.0)))
            world.add_body(spec["table"], Pose((0.55, 0.0, 0.0)))
            world.add_body(spec["box"], Pose(box))
            world.step(2)
            assert BOX_ASIDE.holds(world) is expected, box


def test_size_of_the_table_is_that_of_table_lift() -> None:
    assert dict(TASK.attributes) == dict(get_task("table_lift").attributes)
    assert (dict(TASK.attributes)["table.depth"], dict(TASK.attributes)["table.length"]) == (DEPTH, WIDTH)
