"""hdril-bench measures what it says."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

from hdril.cli import bench
from hdril.cli.bench import BenchConfig, Figure, bench_command, bench_recording
from hdril.demonstrations.provenance import Recipe
from hdril.simulation.world import World


def test_recordings_share_is_of_the_time_that_passed(tmp_path: Path) -> None:
    """And the simulator is as before afterwards."""
    step = World.step
    figure = bench_recording("table_lift", 1, tmp_path / "set")
    assert World.step is step
    assert 0.0 < figure.value < 100.0
    assert (tmp_path / "set/meta/info.json").exists()


def test_several_processes_are_measured_against_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here each takes as long as it waits: twice as many play twice as fast."""

    def play(recipe: Recipe, seeds: Iterator[int], ranks: int) -> Generator[int]:
        for seed in seeds:
            time.sleep(0.02 / ranks)
            yield seed

    monkeypatch.setattr(bench, "play", play)
    figures = bench.bench_ranks("table_lift", 9)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    assert [figure.limit for figure in figures] == [0.7 * min(ranks, cores) for ranks in (2, 4, 8)]
    assert all(figure.at_least and figure.unit == "times" for figure in figures)
    values = [figure.value for figure in figures]
    assert values == sorted(values)
    assert values[0] > 1.3


@pytest.mark.parametrize(
    ("value", "at_least", "verdict"),
    [(1.9, True, "MISS"), (2.0, True, "ok  "), (2.0, False, "ok  "), (2.1, False, "MISS")],
)
def test_a_figure_that_misses_its_limit_says_so(value: float, at_least: bool, verdict: str) -> None:
    bound = "at least 2" if at_least else "at most 2"
    assert str(Figure("speed", value, 2.0, at_least, "times")) == f"{verdict}  speed: {value:.2f} times ({bound})"


@pytest.mark.parametrize(
    ("task", "name"),
    [
        ("table_lift:level=hard", "table_lift"),
        ("peg_in_hole", "peg_in_hole"),
        ("handover", "hard"),
        ("clear_and_lift", "hard"),
    ],
)
def test_every_task_has_a_file_to_train_with(task: str, name: str) -> None:
    path = bench._training_config(task)
    assert path.stem == name
    assert (Path(__file__).parents[2] / path).exists()


@pytest.mark.long
def test_every_figure_is_measured(capsys) -> None:
    bench_command(BenchConfig(episodes=2, train_steps=20))
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 11
    for line in lines:
        assert re.fullmatch(r"(ok  |MISS)  .+: [\d.]+ (%|ms|times) \(at (least|most) [\d.]+\)", line), line
