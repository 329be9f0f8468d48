"""The data, the text and the picture of an evaluation."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hdril.evaluation import results
from hdril.evaluation.report import markdown, write_report
from hdril.evaluation.results import Comparison, Run, compare, headline, summarise
from hdril.evaluation.score import Outcome
from hdril.evaluation.statistics import PairedCounts, mcnemar_exact, paired_difference_interval, wilson_interval
from hdril.tasks import get_task
from tests.evaluation.synthetic import outcome

RUN = Run("table_lift", "somewhere", (), 7, 10, True)


def nine_of_ten() -> list[Outcome]:
    failure: dict[str, Any] = {
        "success": False, "unmet": "table upright, table at rest", "stage": "", "departed_in": "lift", "departed_frame": 30,
        "position_error_cm": 3.0, "ik_failures": 4,
    }  # fmt: skip
    return [outcome(seed, **(failure if seed == 12 else {})) for seed in range(7, 17)]


def report(outcomes: Sequence[Outcome], run: Run = RUN, comparison: Comparison | None = None) -> str:
    return markdown(summarise(run, outcomes, comparison), outcomes)


def rows(text: str, first: str) -> list[list[str]]:
    """Cells of the table whose first head is ``first``, without its heads."""
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if re.match(rf"\| *{re.escape(first)} *\|", line))
    found = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        found.append([cell.strip() for cell in line.strip("|").split("|")])
    return found


# ------------------------------------------------------------------------ data


def test_rates_are_in_percent() -> None:
    data = summarise(RUN, nine_of_ten())
    assert (data["n_success"], data["n_episodes"], data["pc_success"]) == (9, 10, 90.0)
    assert data["pc_success_ci95"] == pytest.approx([100 * v for v in wilson_interval(9, 10)])
    assert data["stages_reached"] == {"success": 9, "none": 1}
    assert data["comparison"] is None
    assert [episode["seed"] for episode in data["per_episode"]] == list(range(7, 17))


def test_errors_are_spreads_over_episodes() -> None:
    data = summarise(RUN, [outcome(0, position_error_cm=1.0), outcome(1, position_error_cm=3.0, dtw_cm=0.3)])
    assert data["position_error_cm"] == pytest.approx({"mean": 2.0, "std": 1.0})
    assert data["dtw_cm"] == pytest.approx({"mean": 0.2, "std": 0.1})
    assert data["angle_error_rad"] == pytest.approx({"mean": 0.002, "std": 0.0})


def test_a_primitive_has_the_errors_of_the_episodes_that_reached_it() -> None:
    data = summarise(
        RUN,
        [
            outcome(0, position_error_cm_by_primitive={"grasp": 0.1, "move": 0.2}),
            outcome(1, position_error_cm_by_primitive={"grasp": 0.3}),
        ],
    )
    assert set(data["position_error_cm_by_primitive"]) == {"grasp", "move"}
    assert data["position_error_cm_by_primitive"]["grasp"] == pytest.approx({"mean": 0.2, "std": 0.1})
    assert data["position_error_cm_by_primitive"]["move"] == pytest.approx({"mean": 0.2, "std": 0.0})


def test_seeds_that_the_expert_fails_count_for_success_but_not_for_errors() -> None:
    far = {"position_error_cm": 50.0, "dtw_cm": 50.0, "angle_error_rad": 3.0, "expert_success": False,
           "position_error_cm_by_primitive": {"grasp": 50.0}}  # fmt: skip
    outcomes = [outcome(0), outcome(1, **far), outcome(2)]
    data = summarise(RUN, outcomes)
    assert (data["n_success"], data["n_expert_failures"]) == (3, 1)
    for key, mean in (("position_error_cm", 0.2), ("dtw_cm", 0.1), ("angle_error_rad", 0.002)):
        assert data[key] == pytest.approx({"mean": mean, "std": 0.0})
    assert data["position_error_cm_by_primitive"]["grasp"]["mean"] == pytest.approx(0.2)
    assert "The expert fails on 1 of 3 seeds; the errors leave them out." in report(outcomes)
    assert "The expert fails" not in report([outcome(0)])


def test_there_may_be_no_error_to_tell(tmp_path: Path) -> None:
    outcomes = [outcome(0, expert_success=False), outcome(1, expert_success=False)]
    data = write_report(tmp_path, RUN, outcomes)
    assert (data["position_error_cm"], data["angle_error_rad"], data["dtw_cm"]) == (None, None, None)
    text = (tmp_path / "report.md").read_text()
    assert "The expert fails on all 2 seeds" in text
    assert "mean ± standard deviation" not in text


def test_jerk_is_compared_with_the_experts_where_both_succeed() -> None:
    def moved(seed: int, ours: float, theirs: float, **changes: Any) -> Outcome:
        return outcome(seed, motion={"jerk_m_s3": ours}, expert_jerk_m_s3=theirs, **changes)

    failures = [moved(2, 100.0, 1.0, success=False), moved(3, 100.0, 1.0, expert_success=False)]
    outcomes = [moved(0, 3.0, 2.0), moved(1, 1.0, 2.0), *failures]
    assert summarise(RUN, outcomes)["jerk_to_expert"] == 1.0
    assert summarise(RUN, outcomes[:1])["jerk_to_expert"] == 1.5
    assert "the hands' jerk is 1.00 times the expert's" in report(outcomes)
    for none in (failures, [outcome(0)]):  # the second is of a version that did not compute it
        assert summarise(RUN, none)["jerk_to_expert"] is None
        assert "jerk" not in report(none)


def test_the_experts_order_is_a_share_of_the_episodes_with_primitives() -> None:
    labels = get_task("table_lift").labels
    outcomes = [
        outcome(0), outcome(1, primitives=("grasp", *labels)), outcome(2, primitives=()), outcome(3, primitives=labels[1:]),
        outcome(4, primitives=labels[1:], expert_primitives=labels[1:]),
    ]  # fmt: skip
    data = summarise(RUN, outcomes)
    assert (data["pc_expert_order"], data["pc_expert_choice"]) == (50.0, 75.0)
    assert "began with the expert's primitive in 75.0 % of episodes" in report(outcomes)
    assert "order of primitives in 50.0 %" in report(outcomes)
    without = [outcome(0, primitives=())]
    data = summarise(RUN, without)
    assert data["pc_expert_order"] is data["pc_expert_choice"] is None
    assert "order of primitives" not in report(without)


def test_the_planners_frames_and_boundaries_are_counted_over_all_episodes() -> None:
    confusion = np.diag([10, 12, 12, 12, 12, 12])
    confusion[2] = [0, 3, 9, 0, 0, 0]
    late = outcome(1, planner_confusion=confusion.tolist(), planner_boundary_hits=[True, True, False, True, True, True])
    outcomes = [outcome(0), late]
    planner = summarise(RUN, outcomes)["planner"]
    assert planner["pc_correct"] == pytest.approx(100 * 137 / 140)
    assert planner["pc_correct_at_boundaries"] == pytest.approx(100 * 11 / 12)
    assert planner["confusion"][2] == [0, 3, 21, 0, 0, 0]
    text = report(outcomes)
    assert "97.86 % of frames, and at 91.67 % of the first frames" in text
    assert rows(text, "")[2] == ["lift", "", "3", "21", "", "", ""]


def test_a_planner_that_was_not_scored_in_every_episode_is_not_reported() -> None:
    outcomes = [outcome(0), outcome(1, planner_confusion=[], planner_boundary_hits=[])]
    assert summarise(RUN, outcomes)["planner"] is None
    assert "## Planner" not in report(outcomes)


def test_no_episodes_are_no_evaluation() -> None:
    with pytest.raises(ValueError, match="0 of 0"):
        summarise(RUN, [])


def test_every_key_is_documented() -> None:
    """The module's docstring is the schema of results.json."""
    data = summarise(RUN, nine_of_ten(), Comparison("other", PairedCounts(7, 2, 1, 0)))
    keys = (line.split("  ")[0] for line in (results.__doc__ or "").splitlines() if line.startswith("``"))
    described = {name for key in keys for name in re.findall(r"``([\w.]+)``", key)}
    nested = {f"{key}.{name}" for key in ("planner", "comparison") for name in data[key]}
    assert described == {*data, *nested}
    assert {field.name for field in fields(Run)} <= described


# ------------------------------------------------------------------ comparison


def test_outcomes_are_compared_seed_by_seed() -> None:
    other = summarise(RUN, [outcome(seed, success=seed not in (8, 9, 12)) for seed in reversed(range(7, 17))])
    comparison = compare("another", nine_of_ten(), json.loads(json.dumps(other)))
    assert comparison.counts == PairedCounts(both=7, first_only=2, second_only=0, neither=1)
    data = summarise(RUN, nine_of_ten(), comparison)["comparison"]
    assert data["against"] == "another"
    assert (data["both"], data["first_only"], data["second_only"], data["neither"]) == (7, 2, 0, 1)
    assert data["pc_difference"] == pytest.approx(20.0)
    interval = paired_difference_interval(comparison.counts)
    assert data["pc_difference_ci95"] == pytest.approx([100 * bound for bound in interval])
    assert data["p_value"] == mcnemar_exact(comparison.counts) == 0.5
    text = report(nine_of_ten(), comparison=comparison)
    assert "Against `another` on the same seeds" in text
    assert "differ by +20.0 percentage points" in text
    assert "p = 0.5." in text
    assert rows(text, "both succeeded") == [["7", "2", "0", "1"]]
    assert "## Comparison" not in report(nine_of_ten())


def test_other_seeds_are_not_compared() -> None:
    with pytest.raises(ValueError, match="the same seeds"):
        compare("another", nine_of_ten(), summarise(RUN, nine_of_ten()[1:]))


# ------------------------------------------------------------------------ text


def test_headline_has_rate_interval_seeds_and_budget() -> None:
    line = headline(summarise(RUN, nine_of_ten()))
    assert line == "9 of 10 succeeded: 90.0 % (95 % interval 59.6 to 98.2), seeds 7 to 16"
    longer = headline(summarise(replace(RUN, max_frames=140), nine_of_ten()))
    assert longer == f"{line}, 140 frames at most"


@pytest.mark.parametrize(
    ("run", "words"),
    [
        (RUN, "seeds 7 to 16**, held out."),
        (replace(RUN, held_out_basis="seeds 0 to 5 trained it"), "**, held out (seeds 0 to 5 trained it)."),
        (replace(RUN, held_out=None, held_out_basis="no record"), "**, not known to be held out (no record)."),
        (replace(RUN, notes=("Its primitives are others.",)), "\n\nIts primitives are others.\n\n"),
        (RUN, "Policy: `somewhere`\n"),
        (replace(RUN, overrides=("--samples=5", "--rollout=open_loop")),
         "Policy: `somewhere` with `--samples=5 --rollout=open_loop`\n"),
    ],
)  # fmt: skip
def test_the_report_says_what_was_evaluated(run: Run, words: str) -> None:
    assert words in report(nine_of_ten(), run)


def test_failures_are_listed_by_reason_and_by_seed() -> None:
    text = report(nine_of_ten())
    assert "did not hold: table upright (1), table at rest (1)." in text
    assert "more than 2 cm from the expert's: lift (1)." in text
    assert "The last stage that was reached: none (1)." in text
    assert rows(text, "seed") == [["12", "table upright, table at rest", "none", "lift", "3.00", "4", "succeeds"]]
    assert "## Failures" not in report([outcome(0)])


def test_a_task_without_stages_has_no_word_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = replace(get_task("table_lift"), stages=())
    monkeypatch.setattr("hdril.evaluation.report.get_task", lambda name: plain)
    text = report(nine_of_ten())
    assert "## Failures" in text
    assert "The last stage" not in text


def test_reasons_are_in_the_order_of_their_number_and_stages_in_that_of_the_task() -> None:
    measures = {"gap_mm": 1.0, "insertion_mm": 2.34567, "offset_mm": 0.0}
    common: dict[str, Any] = {
        "success": False, "measures": measures, "planner_confusion": [], "start": (0.1, 0.2, 0.3, 0.4),
        "position_error_cm_by_primitive": {"align": 1.0},
    }  # fmt: skip
    outcomes = [
        outcome(0, unmet="a", stage="right half placed", departed_in="", **common),
        outcome(1, unmet="b", stage="", departed_in="align", expert_success=False, **common),
        outcome(2, unmet="b", stage="left half placed", departed_in="align", **common),
    ]
    text = report(outcomes, replace(RUN, task="peg_in_hole"))
    assert "did not hold: b (2), a (1)." in text
    assert "reached: none (1), left half placed (1), right half placed (1)." in text
    assert "from the expert's: align (2)." in text
    assert rows(text, "seed")[1] == ["1", "b", "none", "align", "1", "2.346", "0", "0.20", "0", "fails"]


def test_errors_and_their_definition_are_in_the_text() -> None:
    text = report([outcome(0, position_error_cm=1.0), outcome(1, position_error_cm=3.0)])
    assert rows(text, "position, cm") == [["2.00 ± 1.00", "0.0020 ± 0.0000", "0.10 ± 0.00"]]
    assert rows(text, "grasp") == [["0.20 ± 0.00"] * 6]
    assert "D = 1/|P*| Σ" in text


def test_data_text_and_picture_are_written(tmp_path: Path) -> None:
    data = write_report(tmp_path, RUN, nine_of_ten(), Comparison("other", PairedCounts(7, 2, 1, 0)))
    assert json.loads((tmp_path / "results.json").read_text()) == json.loads(json.dumps(data))
    assert (tmp_path / "report.md").read_text() == markdown(data, nine_of_ten())
    assert "(report.png)" in (tmp_path / "report.md").read_text()
    assert (tmp_path / "report.png").stat().st_size > 10_000
