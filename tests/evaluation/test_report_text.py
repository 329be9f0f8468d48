"""A whole report, word by word: what is published reads as in ``expected_report.md``.

python -m tests.evaluation.test_report_text writes that file anew; read the difference before you commit it.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from hdril.evaluation.report import write_report
from hdril.evaluation.results import Comparison, Run
from hdril.evaluation.statistics import PairedCounts
from hdril.tasks import get_task
from tests.evaluation.synthetic import outcome

EXPECTED = Path(__file__).with_name("expected_report.md")
RUN = Run(
    task="peg_in_hole",
    policy="somewhere",
    overrides=("--samples=5",),
    first_seed=7,
    num_episodes=4,
    held_out=True,
    held_out_basis="seeds 0 to 5 trained it",
    max_frames=140,
    notes=("A note.",),
)
COMPARISON = Comparison("another", PairedCounts(both=1, first_only=0, second_only=2, neither=1))


def write(folder: Path) -> dict[str, Any]:
    """A report that has every part: notes, failures of both kinds, a planner, stages and a comparison."""
    labels = get_task("peg_in_hole").labels
    shared = {
        "start": (0.6, 0.1, 0.6, -0.1),
        "measures": {"gap_mm": 1.5, "insertion_mm": 80.25, "offset_mm": 0.0},
        "position_error_cm_by_primitive": {labels[0]: 0.5},
        "primitives": labels,
        "expert_primitives": labels,
        "planner_confusion": [],
    }
    failed = {"success": False, "position_error_cm": 3.0}
    outcomes = [
        outcome(7, **shared),
        outcome(8, **shared, **failed, unmet="gap, level", stage="left half placed", departed_in=labels[2]),
        outcome(9, **shared | {"primitives": labels[1:]}, **failed, unmet="gap", stage="", ik_failures=4),
        outcome(
            10,
            **shared | {"primitives": labels[:2]},
            **failed,
            unmet="gap",
            stage="left half placed",
            expert_success=False,
        ),
    ]
    return write_report(folder, RUN, outcomes, COMPARISON)


def write_lift(folder: Path) -> dict[str, Any]:
    """One of table lift, by a policy with a planner, with a failure on the expert's path."""
    run = replace(RUN, task="table_lift", num_episodes=3, overrides=(), held_out=None, held_out_basis="", notes=())
    failed = outcome(9, success=False, unmet="table at rest", stage="")
    return write_report(folder, replace(run, max_frames=0), [outcome(7), outcome(8), failed])


def written(folder: Path) -> str:
    """Both reports, one after the other."""
    texts = []
    for make in (write, write_lift):
        make(folder)
        texts.append((folder / "report.md").read_text())
    return "\n".join(texts)


def test_reports_read_word_by_word(tmp_path: Path) -> None:
    assert written(tmp_path) == EXPECTED.read_text()


def test_results_are_readable_and_hold_the_comparison(tmp_path: Path) -> None:
    data = write(tmp_path)
    text = (tmp_path / "results.json").read_text()
    assert json.loads(text) == json.loads(json.dumps(data))
    assert json.loads(text)["comparison"]["second_only"] == 2
    assert text.splitlines()[1] == '  "task": "peg_in_hole",'


if __name__ == "__main__":
    import tempfile

    EXPECTED.write_text(written(Path(tempfile.mkdtemp())))
