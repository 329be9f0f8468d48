"""The dataset: its schema, what it keeps and drops, resuming, and making an episode again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets import LeRobotDataset

import hdril.demonstrations.record as recording
from hdril.demonstrations.episode import Episode, demonstrate
from hdril.demonstrations.provenance import Provenance, Recipe, read_provenance
from hdril.demonstrations.record import ExpertError, episodes, record
from hdril.demonstrations.write import write_dataset
from hdril.simulation.actions import ACTION_NAMES
from hdril.tasks import TASKS
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise


@pytest.fixture(scope="module")
def sample() -> list[Episode]:
    """Two real episodes, seeds 0 and 1."""
    stream = episodes(Recipe("table_lift"), 0)
    return [next(stream), next(stream)]


def test_opens_as_a_lerobot_dataset(dataset: Path) -> None:
    loaded = LeRobotDataset("hdril/test", root=dataset)
    task = TASKS["table_lift"]
    assert loaded.num_episodes == 6
    assert loaded.num_frames == 6 * task.horizon
    assert loaded.fps == 10
    frame = loaded[task.horizon + 15]
    assert frame["observation.state"].shape == (16,)
    assert frame["observation.environment_state"].shape == (7,)
    assert frame["action"].shape == (16,)
    assert loaded.features["action"]["names"] == list(ACTION_NAMES)
    assert loaded.features["observation.environment_state"]["names"][0] == "table.x"
    assert frame["task"] == task.description
    assert int(frame["episode_index"]) == 1
    assert float(frame["timestamp"]) == pytest.approx(1.5)
    assert task.labels[int(frame["subtask_index"])] == "move"
    for key in ("observation.state", "observation.environment_state", "action"):
        assert np.isfinite(loaded.meta.stats[key]["std"]).all()


def test_every_episode_ends_in_success(dataset: Path) -> None:
    data = pd.read_parquet(dataset / "data")
    last = data.groupby("episode_index").tail(1)
    assert last["next.success"].all()
    assert last["next.done"].all()
    assert data["next.done"].sum() == 6


def test_primitives_are_named_and_annotated(dataset: Path) -> None:
    task = TASKS["table_lift"]
    names = pd.read_parquet(dataset / "meta/subtasks.parquet")
    assert list(names.index) == list(task.labels)
    meta = LeRobotDataset("hdril/test", root=dataset).meta
    row = meta.episodes[3]
    assert row["seed"] == 3
    assert row["dense_subtask_names"] == [p.name for p in task.primitives]
    assert row["dense_subtask_start_frames"] == [0, 10, 22, 34, 46, 58]
    assert row["dense_subtask_end_frames"][-1] == task.horizon - 1
    shares = json.loads((dataset / "meta/temporal_proportions_dense.json").read_text())
    assert sum(shares.values()) == pytest.approx(1.0)


def test_an_episode_can_be_made_again_bit_for_bit(dataset: Path) -> None:
    provenance = read_provenance(dataset)
    assert provenance is not None
    env = provenance.recipe.make_env()
    episode = demonstrate(env, ScriptedExpert(env.task_spec, provenance.recipe.noise), provenance.seeds[4])
    env.close()
    data = pd.read_parquet(dataset / "data").query("episode_index == 4")
    for column, ours in (
        ("observation.state", episode.state),
        ("observation.environment_state", episode.environment_state),
        ("action", episode.action),
    ):
        assert np.stack(list(data[column])).tobytes() == ours.tobytes(), column


def test_same_dataset_for_any_number_of_workers(dataset: Path, tmp_path: Path) -> None:
    record(Recipe("table_lift"), 3, 0, tmp_path / "parallel", workers=2)
    ours = pd.read_parquet(tmp_path / "parallel/data")
    theirs = pd.read_parquet(dataset / "data").query("episode_index < 3")
    for column in ours:
        np.testing.assert_array_equal(np.stack(list(ours[column])), np.stack(list(theirs[column])), err_msg=column)


def test_noise_varies_demonstrations_and_zero_noise_does_not(sample: list[Episode]) -> None:
    env = Recipe("table_lift").make_env()
    quiet = [demonstrate(env, ScriptedExpert(env.task_spec, Noise(0.0)), 0) for _ in range(2)]
    env.close()
    assert quiet[0].action.tobytes() == quiet[1].action.tobytes()
    difference = np.abs(quiet[0].action - sample[0].action)[:, [0, 1, 2, 8, 9, 10]]
    assert 1e-4 < difference.mean() < 0.02


def scripted(sample: list[Episode], failing: set[int]):
    """A stand-in for the simulator: real frames, under seeds of which some fail."""

    def stream(recipe: Recipe, first_seed: int, workers: int = 1) -> Iterator[Episode]:
        for seed in range(first_seed, first_seed + 10_000):
            fails = seed in failing
            yield replace(sample[seed % 2], seed=seed, success=not fails, unmet="table upright" if fails else "")

    return stream


def test_failures_are_dropped_and_reported(sample, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(recording, "episodes", scripted(sample, {11, 13}))
    result = record(Recipe("table_lift"), 4, 10, tmp_path / "set")
    assert result.seeds == (10, 12, 14, 15)
    assert result.dropped == {11: "table upright", 13: "table upright"}
    provenance = json.loads((tmp_path / "set/meta/hdril.json").read_text())
    assert provenance["dropped"] == {"11": "table upright", "13": "table upright"}
    assert LeRobotDataset("hdril/test", root=tmp_path / "set").num_episodes == 4


def test_a_hopeless_expert_stops_the_recording(sample, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(recording, "episodes", scripted(sample, set(range(1000))))
    with pytest.raises(ExpertError, match="the expert failed on 21 of 21 seeds"):
        record(Recipe("table_lift"), 4, 0, tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_an_interrupted_recording_goes_on(sample, tmp_path, monkeypatch) -> None:
    made = []

    def interrupted(recipe: Recipe, first_seed: int, workers: int = 1) -> Iterator[Episode]:
        for episode in scripted(sample, {2})(recipe, first_seed, workers):
            if len(made) == 3:
                raise KeyboardInterrupt
            made.append(episode.seed)
            yield episode

    monkeypatch.setattr(recording, "episodes", interrupted)
    root = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        record(Recipe("table_lift"), 4, 0, root)
    assert not root.exists()
    asked = []

    def rest(recipe: Recipe, first_seed: int, workers: int = 1) -> Iterator[Episode]:
        asked.append(first_seed)
        return scripted(sample, {2})(recipe, first_seed, workers)

    monkeypatch.setattr(recording, "episodes", rest)
    with pytest.raises(ValueError, match="another recipe"):
        record(Recipe("table_lift", Noise(0.0)), 4, 0, root)
    result = record(Recipe("table_lift"), 4, 0, root)
    assert asked == [3]
    assert result.seeds == (0, 1, 3, 4)
    assert result.dropped == {2: "table upright"}
    assert not root.with_name("set.partial").exists()


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"unknown task 'chess'; choose from: .*table_lift"):
        Recipe("chess")
    recipe = Recipe("table_lift")
    (tmp_path / "there").mkdir()
    with pytest.raises(FileExistsError, match="there exists"):
        record(recipe, 1, 0, tmp_path / "there")
    for bad in ({"num_episodes": 0}, {"first_seed": -1}, {"workers": 0}):
        with pytest.raises(ValueError, match="got"):
            record(recipe, **{"num_episodes": 1, "first_seed": 0, "root": tmp_path / "x"} | bad)
    with pytest.raises(ValueError, match=r"noise\.waypoint"):
        Noise(0.5)
    assert list(tmp_path.iterdir()) == [tmp_path / "there"]


def test_rerun_shows_the_primitives_as_text(dataset: Path, tmp_path: Path) -> None:
    """Rerun's own LeRobot loader, read back with Rerun's own reader."""
    import subprocess
    import sys

    out = tmp_path / "dataset.rrd"
    rerun = Path(sys.executable).with_name("rerun")
    subprocess.run([rerun, str(dataset), "--save", str(out)], check=True, capture_output=True, timeout=120)
    text = subprocess.run(
        [rerun, "rrd", "print", "-vvv", str(out)], check=True, capture_output=True, timeout=120
    ).stdout
    for name in TASKS["table_lift"].labels:
        assert name.encode() in text, name


def test_written_frames_are_what_was_recorded(sample: list[Episode], tmp_path: Path) -> None:
    write_dataset(tmp_path / "set", Provenance(Recipe("table_lift"), (0, 1)), sample)
    data = LeRobotDataset("hdril/test", root=tmp_path / "set")
    np.testing.assert_array_equal(data[75]["action"].numpy(), sample[1].action[5])
    assert int(data[75]["subtask_index"]) == sample[1].label[5]
