"""Suites: their cells, pairs that are the same until the event, the table, and going on after a break."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lerobot.configs.types import FeatureType, PolicyFeature

import hdril.cli.suite
from hdril.actor import ReplayActor
from hdril.cli.eval import EvalConfig, PolicySource, eval_command
from hdril.env import BimanualEnv
from hdril.evaluation import reference
from hdril.evaluation.report import write_report
from hdril.evaluation.results import Run, summarise
from hdril.evaluation.score import Outcome
from hdril.evaluation.suite import CONTROL, NOMINAL, VARIED_CONTROL, Cell, choose, factor_cells
from hdril.evaluation.suite_report import suite_markdown
from hdril.evaluation.suite_table import tabulate_suite
from hdril.tasks import TASKS, get_task
from hdril.tasks.scenario import Scenario
from hdril.trace import Trace, trace_episode
from tests.evaluation.checkpoints import experts_episode, listing, save_hdril, save_replay
from tests.evaluation.synthetic import outcome

SEED = 930_000
TRIED = [name for name in TASKS if TASKS[name].factors or TASKS[name].events]
each_task = pytest.mark.parametrize("task", TRIED)


@pytest.fixture(scope="module")
def expert() -> Trace:
    return experts_episode(SEED)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache of the expert's episodes."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def config_of(policy: Path, output: Path, **options) -> EvalConfig:
    given = {"num_episodes": 2, "seed": SEED, "workers": 1, "rerun": "none", "suite": "factors", "cells": "push"}
    return EvalConfig(PolicySource(str(policy)), output_dir=output, **(given | options))


def observing(width: int) -> dict[str, PolicyFeature]:
    return {"observation.environment_state": PolicyFeature(FeatureType.ENV, (width,))}


# -------------------------------------------------------------- cells


@each_task
@pytest.mark.parametrize("detailed", [False, True])
def test_each_factor_and_each_event_has_a_cell_and_all_cells_observe_the_same(task: str, detailed: bool) -> None:
    spec, cells = TASKS[task], factor_cells(task, detailed)
    names = [cell.name for cell in cells]
    assert len(set(names)) == len(names)
    assert set(names) >= {NOMINAL, "varied", *(f.name for f in spec.all_factors), *(e.name for e in spec.events)}
    width = len(replace(spec, detailed=detailed).state_names)
    for cell in cells:
        assert len(get_task(cell.task).state_names) == width, cell.task
        spans, rates = get_task(cell.task).variation.spans, get_task(cell.task).variation.rates
        if cell.kind == "factor":
            (factor,) = (f for f in spec.all_factors if f.name == cell.name)
            assert spans == {cell.name: factor.span}
        if cell.kind == "event":
            assert (spans, rates) == ({}, {cell.name: 1.0})


@pytest.mark.parametrize("task", [name for name in TRIED if TASKS[name].events])
def test_controls_have_the_scenes_and_the_budget_of_what_they_control(task: str) -> None:
    cells = {cell.name: cell for cell in factor_cells(task, False)}
    for cell in (cells[name] for name in ("hard", *(event.name for event in TASKS[task].events))):
        ours, control = get_task(cell.task), get_task(cells[cell.control].task)
        assert cells[cell.control].max_frames == ours.budget >= control.budget
        for seed in range(SEED, SEED + 3):
            scene = ours.sample(seed)
            assert scene.events
            assert replace(scene.without_events(), task=control.name) == control.sample(seed)


def test_parameters_of_the_task_itself_stay() -> None:
    cells = {cell.name: cell.task for cell in factor_cells("peg_in_hole:clearance=0.003", False)}
    assert cells[NOMINAL] == "peg_in_hole:clearance=0.003"
    assert cells["posture"] == "peg_in_hole:clearance=0.003,posture=0.1,detailed=0"


def test_chosen_cells_come_with_what_they_are_compared_with() -> None:
    cells = factor_cells("table_lift", False)
    assert [cell.name for cell in choose(cells, ["push", "yaw"])] == [NOMINAL, "yaw", "push", CONTROL]
    assert [cell.name for cell in choose(cells, ["hard"])] == [NOMINAL, "hard", VARIED_CONTROL]
    assert choose(cells, []) == cells
    with pytest.raises(ValueError, match=r"^unknown cell 'control'; choose from: nominal, yaw, .*push.*, hard$"):
        choose(cells, [CONTROL])


# -------------------------------------------------------------- pairs


@pytest.mark.parametrize("event", ["push", "platform_slide", "open_hand", "freeze"])
def test_event_and_control_are_the_same_to_the_last_bit_until_the_event(event: str, expert: Trace) -> None:
    """The same commands, with the event and without: what is seen and what is there first differs after the event."""
    env = BimanualEnv(f"table_lift:{event}=1", max_episode_steps=70)
    actor = ReplayActor(expert.action)
    with closing(env):
        scenario = env.task_spec.sample(SEED)
        ours, _ = trace_episode(env, actor, SEED, scenario=scenario)
        control, _ = trace_episode(env, actor, SEED, scenario=scenario.without_events())
    (begun,) = scenario.events
    assert [(frame, text) for frame, text in enumerate(ours.events) if text] == [(begun.frame, str(begun))]
    assert not any(control.events)
    assert (ours.scenario, control.scenario) == (scenario, scenario.without_events())
    before = slice(0, begun.frame + 1)
    for name in ("state", "environment_state", "joints", "grip_force", "peak_force"):
        np.testing.assert_array_equal(getattr(ours, name)[before], getattr(control, name)[before])
    for body in ours.poses:
        np.testing.assert_array_equal(ours.poses[body][before], control.poses[body][before])
    after = min(len(ours.state), len(control.state))
    assert any(
        (getattr(ours, name)[:after] != getattr(control, name)[:after]).any() for name in ("state", "environment_state")
    )


# -------------------------------------------------------------- the table


def results_of(task: str, successes: str, **changes) -> dict:
    """Results of made-up episodes: ``+`` succeeds, ``-`` fails."""
    scene = Scenario(task, 0, {}, {})
    motion = {
        "path_length_m": 2.0,
        "jerk_m_s3": 7.0,
        "slip_m": 0.01,
        "peak_force_n": 80.0,
        "peak_height_difference_m": 0.1,
    }
    outcomes: list[Outcome] = [
        outcome(
            seed, success=mark == "+", unmet="" if mark == "+" else "table upright", stages=1 if mark == "+" else 0,
            motion=motion | {"path_length_m": float(seed)}, scenario=replace(scene, seed=seed).to_json(), **changes,
        )
        for seed, mark in enumerate(successes)
    ]  # fmt: skip
    run = Run("table_lift", "somewhere", (), 0, len(successes), None, "a reason", identity={"policy": {"type": "act"}})
    return json.loads(json.dumps(summarise(run, outcomes)))


CELLS = (
    Cell(NOMINAL, "nominal", "table_lift"),
    Cell("yaw", "factor", "table_lift:yaw=30"),
    Cell("push", "event", "table_lift:push=1", CONTROL),
    Cell("hard", "hard", "table_lift:level=hard", VARIED_CONTROL),
    Cell(CONTROL, "control", "table_lift", max_frames=210),
    Cell(VARIED_CONTROL, "control", "table_lift:level=varied", max_frames=210),
)


def made_up_table() -> dict:
    marks = ("+++++++-", "+++----+", "-------+", "++------", "++++++++", "++++----")
    results = {cell.name: results_of(cell.task, m) for cell, m in zip(CELLS, marks, strict=True)}
    return tabulate_suite("factors", "table_lift", CELLS, results)


def test_rows_tell_success_drop_stages_and_motion() -> None:
    table = made_up_table()
    rows = {row["cell"]: row for row in table["rows"]}
    assert list(rows) == [NOMINAL, "yaw", "push", "hard"]
    assert [row["cell"] for row in table["controls"]] == [CONTROL, VARIED_CONTROL]
    assert table["identity"] == {"type": "act"}
    assert rows[NOMINAL]["against_nominal"] is None
    yaw = rows["yaw"]
    assert (yaw["n_success"], yaw["pc_success"], yaw["stages"]) == (4, 50.0, 0.5)
    assert yaw["against_nominal"]["pc_difference"] == -37.5
    assert (yaw["against_nominal"]["first_only"], yaw["against_nominal"]["second_only"]) == (1, 4)
    assert yaw["against_control"] is None
    assert yaw["motion"]["path_length_m"] == 3.5


def test_events_are_paired_with_their_own_controls_and_adjusted_together() -> None:
    rows = {row["cell"]: row for row in made_up_table()["rows"]}
    push, hard = rows["push"]["against_control"], rows["hard"]["against_control"]
    assert (push["both"], push["second_only"], push["pc_difference"]) == (1, 7, -87.5)
    assert (hard["both"], hard["second_only"], hard["pc_difference"]) == (2, 2, -25.0)
    assert push["p_value"] == pytest.approx(2 * 0.5**7)
    assert push["p_holm"] == pytest.approx(2 * push["p_value"])
    assert hard["p_holm"] == pytest.approx(hard["p_value"])
    low, high = push["pc_difference_ci95"]
    assert -100.0 < low < -87.5 < high < 0.0


def test_cells_of_other_scenes_are_no_pair() -> None:
    results = {cell.name: results_of(cell.task, "++") for cell in CELLS}
    other = Scenario("table_lift", 1, {"yaw": 3.0}, {}).to_json()
    results["push"]["per_episode"][1]["scenario"] = other
    with pytest.raises(ValueError, match=r"^seed 1 of push and of control are other scenes: no pair$"):
        tabulate_suite("factors", "table_lift", CELLS, results)


def test_the_report_names_rows_pairs_and_motion() -> None:
    text = suite_markdown(made_up_table())
    assert "| [yaw](yaw/report.md) " in text
    assert "| 50.0 (21.5 to 78.5) " in text
    assert "| -37.5 (" in text
    (push,) = (line for line in text.splitlines() if line.startswith("| push ") and "-87.5" in line)
    assert [cell.strip() for cell in push.split("|")][2:4] == ["12.5", "100.0"]
    assert "0.0100" in text


# -------------------------------------------------------------- an evaluation names events


def test_a_report_names_each_event_and_what_the_policy_noticed_at_its_time(tmp_path: Path) -> None:
    run = Run("table_lift:push=1", "somewhere", (), 0, 2, None)
    noticed = ((14, "grasp tried again"), (20, "lift tried again"), (26, "grasp tried again"))
    pushed = outcome(1, success=False, unmet="table upright", events=((3, "push: table (0.80 N s)"),), noticed=noticed)
    write_report(tmp_path, run, [outcome(0), pushed, outcome(2, noticed=((5, "move tried again"),))])
    lines = [[cell.strip() for cell in line.split("|")] for line in (tmp_path / "report.md").read_text().splitlines()]
    said = "grasp tried again at 1.4 s, 2.6 s; lift tried again at 2.0 s"
    assert ["", "1", "push: table (0.80 N s) at 0.3 s", said, "failure: table upright", ""] in lines
    assert ["", "2", "", "move tried again at 0.5 s", "success", ""] in lines
    write_report(tmp_path, run, [outcome(0)])
    assert "## Events" not in (tmp_path / "report.md").read_text()


# -------------------------------------------------------------- the command


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds that the expert plays."""
    played: list[int] = []

    def play(env: BimanualEnv, actor, seed: int):
        played.append(seed)
        return trace_episode(env, actor, seed)

    monkeypatch.setattr(reference, "trace_episode", play)
    return played


def test_a_suite_makes_a_table_and_a_second_policy_plays_no_expert_again(
    expert: Trace, cache: None, counted: list[int], tmp_path: Path
) -> None:
    eval_command(config_of(save_replay(tmp_path / "good", expert.action), tmp_path / "eval"))
    assert counted == [SEED, SEED + 1] * 2, "the nominal cell and the event; the control's expert is the nominal one's"
    table = json.loads((tmp_path / "eval/suite.json").read_text())
    rows = {row["cell"]: row for row in table["rows"]}
    assert list(rows) == [NOMINAL, "push"]
    assert [row["task"] for row in table["rows"]] == ["table_lift", "table_lift:push=1,detailed=0"]
    assert rows[NOMINAL]["n_success"] == 1, "it plays what the expert does on the first of the two seeds"
    assert rows[NOMINAL]["motion"]["path_length_m"] > 1.0
    cell = json.loads((tmp_path / "eval/push/results.json").read_text())
    scenario = Scenario.from_json(cell["per_episode"][0]["scenario"])
    assert scenario == get_task("table_lift:push=1,detailed=0").sample(SEED)
    assert cell["per_episode"][0]["events"] == [[scenario.events[0].frame, str(scenario.events[0])]]
    assert str(scenario.events[0]) in (tmp_path / "eval/push/report.md").read_text()
    assert (tmp_path / "eval/suite.png").stat().st_size > 0
    assert {path.name for path in (tmp_path / "eval").iterdir()} == {
        "suite.json", "suite.md", "suite.png", NOMINAL, "push", CONTROL,
    }  # fmt: skip

    counted.clear()
    width = len(get_task("table_lift:detailed=1").state_names)
    still = save_replay(tmp_path / "still", expert.action[:1], input_features=observing(width))
    eval_command(config_of(still, tmp_path / "other", against=tmp_path / "eval"))
    assert counted == []
    other = json.loads((tmp_path / "other/suite.json").read_text())
    assert [row["task"] for row in other["rows"]] == ["table_lift:detailed=1", "table_lift:push=1,detailed=1"]


class StopError(Exception):
    """In place of Ctrl-C."""


def stopping_at(monkeypatch: pytest.MonkeyPatch, cell: str) -> list[str]:
    """Stop the suite at a cell, once; gives the names of the cells that are evaluated."""
    evaluated: list[str] = []
    evaluate: Callable = hdril.cli.suite.evaluate_into

    def evaluate_into(output: Path, *arguments):
        if output.name == cell and cell not in evaluated:
            evaluated.append(cell)
            raise StopError
        evaluated.append(output.name)
        return evaluate(output, *arguments)

    monkeypatch.setattr(hdril.cli.suite, "evaluate_into", evaluate_into)
    return evaluated


def test_a_suite_goes_on_where_it_was_stopped_and_only_with_the_same_policy(
    expert: Trace, cache: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, still = save_replay(tmp_path / "good", expert.action), save_replay(tmp_path / "still", expert.action[:1])
    evaluated = stopping_at(monkeypatch, "push")
    with pytest.raises(StopError):
        eval_command(config_of(good, tmp_path / "eval", num_episodes=1))
    assert evaluated == [NOMINAL, "push"]
    before = listing(tmp_path / "eval.partial")
    for options, message in (
        ({"policy": PolicySource(str(still))}, r"eval\.partial holds results of other weights"),
        ({"cells": "push,yaw"}, r"eval\.partial holds results of other cells"),
        ({"seed": SEED + 1}, r"eval\.partial holds results of other first seed"),
    ):
        with pytest.raises(ValueError, match=message):
            eval_command(replace(config_of(good, tmp_path / "eval", num_episodes=1), **options))
    assert listing(tmp_path / "eval.partial") == before
    evaluated.append("push")  # it stops no more
    del evaluated[:1]
    eval_command(config_of(good, tmp_path / "eval", num_episodes=1))
    assert evaluated[2:] == ["push", CONTROL], "the nominal cell was finished"
    assert not (tmp_path / "eval.partial").exists()
    with pytest.raises(FileExistsError, match="eval exists"):
        eval_command(config_of(good, tmp_path / "eval", num_episodes=1))


def test_a_suite_that_fails_at_once_leaves_nothing(
    expert: Trace, cache: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = save_replay(tmp_path / "p", expert.action)
    stopping_at(monkeypatch, NOMINAL)
    before = listing(tmp_path)
    with pytest.raises(StopError):
        eval_command(config_of(policy, tmp_path / "new/eval", num_episodes=1))
    assert listing(tmp_path) == before


@pytest.mark.portable
def test_rows_do_not_depend_on_workers(dataset: Path, cache: None, tmp_path: Path) -> None:
    """One pool plays all cells, one after the other."""
    policy = save_hdril(tmp_path / "p", dataset)
    for workers in (1, 2):
        eval_command(config_of(policy, tmp_path / f"eval{workers}", workers=workers, cells="yaw"))
    one, two = (json.loads((tmp_path / f"eval{workers}/suite.json").read_text()) for workers in (1, 2))
    assert one == two


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"suite": "vibes"}, r"^unknown suite 'vibes'; choose from: factors$"),
        ({"cells": "push,pull"}, r"^unknown cell 'pull'; choose from: nominal, yaw, "),
        ({"suite": ""}, r"^cells are those of a suite: add --suite=factors$"),
        (
            {"task": "table_lift:yaw=3,any_event=1"},
            r"^the suite factors sets yaw, any_event itself: give the task without$",
        ),
        ({"max_frames": 300}, r"^max_frames is an option of one evaluation, not of a suite"),
        ({"push": "me/policy"}, r"^push is an option of one evaluation, not of a suite"),
    ],
)
def test_what_is_no_suite_is_refused_in_one_line(expert: Trace, tmp_path: Path, options: dict, message: str) -> None:
    policy = save_replay(tmp_path / "p", expert.action[:1])
    before = listing(tmp_path)
    with pytest.raises(ValueError, match=message):
        eval_command(config_of(policy, tmp_path / "eval", **options))
    assert listing(tmp_path) == before


def test_a_task_that_declares_nothing_has_no_suite(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "hdril.evaluation.suite.get_task", lambda name: replace(get_task(name), factors=(), events=(), vary=None)
    )
    with pytest.raises(ValueError, match=r"^table_lift declares neither factors nor events: there is nothing to try"):
        eval_command(EvalConfig(PolicySource("nowhere"), suite="factors"))


@pytest.mark.parametrize(
    ("task", "suite", "width", "message"),
    [
        (
            "table_lift",
            "factors",
            9,
            r"p takes 9 numbers of the objects; table_lift has 7, or 17 with all that may vary$",
        ),
        (
            "table_lift:yaw=30",
            "",
            7,
            r"p takes 7 numbers of the objects, table_lift:yaw=30 gives 17; add detailed=0 to the task$",
        ),
        ("table_lift", "", 17, r"p takes 17 numbers of the objects, table_lift gives 7; add detailed=1 to the task$"),
        ("table_lift", "", 9, r"p takes 9 numbers of the objects, table_lift gives 7$"),
    ],
)
def test_a_policy_that_takes_other_numbers_is_refused(
    expert: Trace, tmp_path: Path, task: str, suite: str, width: int, message: str
) -> None:
    policy = save_replay(tmp_path / "p", expert.action[:1], input_features=observing(width))
    with pytest.raises(ValueError, match=message):
        eval_command(config_of(policy, tmp_path / "eval", task=task, suite=suite, cells=""))
    assert not (tmp_path / "eval").exists()
    assert not (tmp_path / "eval.partial").exists()
