"""The dataset: its schema, what it keeps and drops, resuming, and making an episode again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets import LeRobotDataset

import hdril.demonstrations.record as recording
from hdril.demonstrations.episode import Episode, demonstrate
from hdril.demonstrations.provenance import Recipe, read_provenance
from hdril.demonstrations.read import read_episode
from hdril.demonstrations.record import ExpertError, episodes, record
from hdril.errors import UserError
from hdril.files import MAX_SEED, BusyError, exclusively
from hdril.simulation.actions import ACTION_NAMES, hand_poses
from hdril.tasks import TASKS
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from tests.demonstrations.broken import Broken


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


def test_noise_varies_demonstrations_and_zero_noise_does_not(dataset: Path) -> None:
    env = Recipe("table_lift").make_env()
    quiet = [demonstrate(env, ScriptedExpert(env.task_spec, Noise(0.0)), 0) for _ in range(2)]
    env.close()
    assert quiet[0].action.tobytes() == quiet[1].action.tobytes()
    difference = hand_poses(quiet[0].action) - hand_poses(read_episode(dataset, 0).action)
    assert 1e-4 < np.abs(difference[..., :3]).mean() < 0.02  # m


Stream = Callable[..., Generator[Episode]]


def scripted(made_up: Callable[..., Episode], failing: Iterable[int] = (), until: int = 10_000) -> Stream:
    """A stand-in for the simulator: made-up episodes, some of which fail, up to a largest seed."""

    def stream(recipe: Recipe, first_seed: int, workers: int = 1) -> Generator[Episode]:
        for seed in range(first_seed, until):
            yield made_up(seed, success=seed not in failing)

    return stream


def test_failures_are_dropped_and_reported(made_up, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(recording, "episodes", scripted(made_up, {11, 13}))
    counts = []
    made = record(Recipe("table_lift"), 4, 10, tmp_path / "set", progress=lambda *both: counts.append(both))
    assert made.seeds == (10, 12, 14, 15)
    assert made.dropped == {11: "table upright", 13: "table upright"}
    assert counts == [(1, 0), (1, 1), (2, 1), (2, 2), (3, 2), (4, 2)]
    assert read_provenance(tmp_path / "set") == made
    actions = np.stack(list(pd.read_parquet(tmp_path / "set/data")["action"]))
    np.testing.assert_array_equal(actions, np.concatenate([made_up(seed).action for seed in made.seeds]))
    assert list(tmp_path.iterdir()) == [tmp_path / "set"]


@pytest.mark.parametrize(("successes", "tolerated"), [(0, 20), (3, 23)])
def test_a_hopeless_expert_stops_the_recording(successes, tolerated, made_up, tmp_path: Path, monkeypatch) -> None:
    """Twenty more failures than successes are borne, and one more is not; then nothing stays."""
    fail = set(range(successes, successes + tolerated))
    monkeypatch.setattr(recording, "episodes", scripted(made_up, fail))
    assert len(record(Recipe("table_lift"), successes + 1, 0, tmp_path / "set").dropped) == tolerated
    shutil.rmtree(tmp_path / "set")
    monkeypatch.setattr(recording, "episodes", scripted(made_up, fail | {successes + tolerated}))
    message = f"the expert failed on {tolerated + 1} of {tolerated + 1 + successes} seeds; last: table upright"
    with pytest.raises(ExpertError, match=message):
        record(Recipe("table_lift"), successes + 1, 0, tmp_path / "set")
    assert not list(tmp_path.iterdir())


def interrupted(stream: Stream, after: int, error: type[BaseException] = KeyboardInterrupt) -> Stream:
    """The stream, cut off by an exception after so many episodes."""

    def cut(recipe: Recipe, first_seed: int, workers: int = 1) -> Generator[Episode]:
        yield from islice(stream(recipe, first_seed, workers), after)
        raise error

    return cut


def test_an_interrupted_recording_goes_on(made_up, tmp_path: Path, monkeypatch) -> None:
    root, asked = tmp_path / "set", []
    monkeypatch.setattr(recording, "episodes", interrupted(scripted(made_up, {2}), 3))
    with pytest.raises(KeyboardInterrupt):
        record(Recipe("table_lift"), 4, 0, root)
    assert not root.exists()

    def rest(recipe: Recipe, first_seed: int, workers: int = 1) -> Generator[Episode]:
        asked.append(first_seed)
        return scripted(made_up, {2})(recipe, first_seed, workers)

    monkeypatch.setattr(recording, "episodes", rest)
    with pytest.raises(ValueError, match="another recipe"):
        record(Recipe("table_lift", Noise(0.0)), 4, 0, root)
    made = record(Recipe("table_lift"), 4, 0, root)
    assert asked == [3]
    assert made.seeds == (0, 1, 3, 4)
    assert made.dropped == {2: "table upright"}
    assert list(tmp_path.iterdir()) == [root]


def test_episodes_that_are_there_suffice(made_up, tmp_path: Path, monkeypatch) -> None:
    root = tmp_path / "set"
    monkeypatch.setattr(recording, "episodes", interrupted(scripted(made_up, {1}), 5))
    with pytest.raises(KeyboardInterrupt):
        record(Recipe("table_lift"), 6, 0, root)
    monkeypatch.setattr(recording, "episodes", interrupted(scripted(made_up), 0, AssertionError))
    assert record(Recipe("table_lift"), 3, 0, root).seeds == (0, 2, 3)


def test_an_unreadable_episode_is_made_again(made_up, tmp_path: Path, monkeypatch, capsys) -> None:
    root = tmp_path / "set"
    monkeypatch.setattr(recording, "episodes", interrupted(scripted(made_up), 3))
    with pytest.raises(KeyboardInterrupt):
        record(Recipe("table_lift"), 4, 0, root)
    (tmp_path / "set.partial/1.npz").write_bytes(b"power cut")
    monkeypatch.setattr(recording, "episodes", scripted(made_up))
    assert record(Recipe("table_lift"), 4, 0, root).seeds == (0, 1, 2, 3)
    assert "1.npz is damaged: " in capsys.readouterr().out
    np.testing.assert_array_equal(read_episode(root, 1).action, made_up(1).action)


def test_a_second_process_on_the_same_root_is_refused(made_up, tmp_path: Path, monkeypatch) -> None:
    root = tmp_path / "set"
    monkeypatch.setattr(recording, "episodes", scripted(made_up))
    with exclusively(tmp_path / "set.partial", "recording"), pytest.raises(BusyError, match=f"recording to {root}"):
        record(Recipe("table_lift"), 1, 0, root)
    assert record(Recipe("table_lift"), 1, 0, root).seeds == (0,)


def test_a_root_that_another_process_finished_meanwhile_is_refused(tmp_path: Path, monkeypatch) -> None:
    root = tmp_path / "set"

    @contextmanager
    def late(folder: Path, doing: str) -> Iterator[None]:
        root.mkdir()
        with exclusively(folder, doing):
            yield

    monkeypatch.setattr(recording, "exclusively", late)
    with pytest.raises(FileExistsError, match="set exists"):
        record(Recipe("table_lift"), 1, 0, root)
    assert list(tmp_path.iterdir()) == [root]


def test_only_what_one_can_go_on_from_stays_after_a_failure(made_up, tmp_path: Path, monkeypatch) -> None:
    for after, left in ((0, []), (1, ["set.partial"])):
        monkeypatch.setattr(recording, "episodes", interrupted(scripted(made_up), after, ZeroDivisionError))
        with pytest.raises(ZeroDivisionError):
            record(Recipe("table_lift"), 4, 0, tmp_path / "set")
        assert [path.name for path in tmp_path.iterdir()] == left


def test_seeds_end_somewhere(made_up, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(recording, "episodes", scripted(made_up, {1}, until=4))
    with pytest.raises(ValueError, match="only 3 demonstrations succeeded"):
        record(Recipe("table_lift"), 4, 0, tmp_path / "set")
    assert record(Recipe("table_lift"), 3, 0, tmp_path / "set").seeds == (0, 2, 3)


@pytest.mark.parametrize("workers", [1, 2])
def test_the_largest_seed_is_played(workers: int, monkeypatch) -> None:
    monkeypatch.setattr(recording, "MAX_SEED", 1)
    assert [episode.seed for episode in episodes(Recipe("table_lift"), 0, workers)] == [0, 1]


def test_a_bug_in_a_worker_process_keeps_its_traceback(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="no body 'chair'") as caught:
        record(Broken("table_lift"), 1, 0, tmp_path / "set", workers=2)
    assert "in make_env" in str(caught.value.__cause__)
    assert not list(tmp_path.iterdir())


def test_a_worker_that_is_killed_is_no_bug(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a worker process was killed; 2 workers may need more memory"):
        record(Broken("table_lift", killed=True), 1, 0, tmp_path / "set", workers=2)
    assert not list(tmp_path.iterdir())


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"unknown task 'chess'; choose from: .*table_lift"):
        Recipe("chess")
    with pytest.raises(ValueError, match="unknown robot 'dog'; choose from: baxter"):
        Recipe("table_lift", robot="dog")
    recipe = Recipe("table_lift")
    (tmp_path / "there").mkdir()
    with pytest.raises(FileExistsError, match="there exists"):
        record(recipe, 1, 0, tmp_path / "there")
    for bad, message in (
        ({"num_episodes": 0}, "num_episodes must be at least 1, got 0"),
        ({"first_seed": -1}, "got -1"),
        ({"first_seed": MAX_SEED}, f"seed must be from 0 to {MAX_SEED - 1}, got {MAX_SEED}"),
        ({"workers": 0}, "workers must be at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
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
