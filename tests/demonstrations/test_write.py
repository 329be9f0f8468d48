"""A written dataset: what each column holds, and how it is read back."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets import LeRobotDataset

from hdril.demonstrations.episode import Episode
from hdril.demonstrations.provenance import Provenance, Recipe
from hdril.demonstrations.read import Signal, feature_names, read_episode, read_primitives
from hdril.demonstrations.schema import PROPORTIONS_PATH, SUBTASKS_PATH
from hdril.demonstrations.write import write_dataset
from hdril.simulation.actions import ACTION_NAMES, hand_poses
from hdril.simulation.robots import SIDES
from hdril.tasks import TASKS
from hdril.tasks.scenario import Scenario
from tests.evaluation.checkpoints import listing

Written = tuple[Path, list[Episode]]


@pytest.fixture(scope="module")
def written(made_up: Callable[..., Episode], tmp_path_factory: pytest.TempPathFactory) -> Written:
    """Two episodes of different lengths; the second plays a primitive three times, twice in a row."""
    root = tmp_path_factory.mktemp("written") / "set"
    again = made_up(9, frames=5, label=[1, 1, 0, 1, 1])
    again.start[4] = True
    episodes = [made_up(7), again]
    write_dataset(root, Provenance(Recipe("table_lift"), (7, 9), {8: "table upright"}), episodes)
    return root, episodes


def test_frames_are_numbered_and_timed(written: Written) -> None:
    data = pd.read_parquet(written[0] / "data")
    assert data["index"].tolist() == list(range(17))
    assert data["episode_index"].tolist() == [0] * 12 + [1] * 5
    assert data["frame_index"].tolist() == [*range(12), *range(5)]
    assert data["timestamp"].to_numpy() == pytest.approx([0.1 * i for i in (*range(12), *range(5))])
    assert data["next.done"].tolist() == [i in (11, 16) for i in range(17)]
    assert data["next.success"].tolist() == data["next.done"].tolist()


def test_columns_are_what_was_demonstrated(written: Written) -> None:
    root, episodes = written
    data = pd.read_parquet(root / "data")
    columns = {
        "observation.state": "state", "observation.environment_state": "environment_state", "action": "action",
        "subtask_index": "label", "subtask_start": "start", "next.reward": "reward",
    }  # fmt: skip
    for column, field in columns.items():
        expected = np.concatenate([getattr(episode, field) for episode in episodes])
        np.testing.assert_array_equal(np.stack(list(data[column])), expected, err_msg=column)


def test_lerobot_reads_it_with_its_statistics(written: Written) -> None:
    root, episodes = written
    loaded = LeRobotDataset("any/name", root=root)
    assert (loaded.num_episodes, loaded.num_frames, loaded.fps) == (2, 17, 10)
    np.testing.assert_array_equal(loaded[13]["action"].numpy(), episodes[1].action[1])
    actions = np.concatenate([episode.action for episode in episodes])
    np.testing.assert_allclose(loaded.meta.stats["action"]["mean"], actions.mean(axis=0), rtol=1e-4, atol=1e-5)
    assert [row["seed"] for row in loaded.meta.episodes] == [7, 9]


def test_files_are_closed_when_they_are_full(made_up: Callable[..., Episode], tmp_path: Path) -> None:
    """Half a MB an episode, in files of 1 MB; the episodes come one at a time."""
    frames, count, root = 2500, 7, tmp_path / "set"
    provenance = Provenance(Recipe("table_lift"), tuple(range(count)))
    made = write_dataset(root, provenance, (made_up(seed, frames) for seed in range(count)), file_mb=1)
    files = sorted(path.relative_to(root / "data") for path in (root / "data").rglob("*.parquet"))
    assert len(files) >= 3
    assert [path.name for path in files] == [f"file-{i:03d}.parquet" for i in range(len(files))]
    loaded = LeRobotDataset("any/name", root=root)
    assert loaded.num_frames == len(loaded.hf_dataset) == count * frames
    places = [(row["data/chunk_index"], row["data/file_index"]) for row in loaded.meta.episodes]
    assert places == sorted(places)
    assert len(set(places)) == len(files)
    for index, (chunk, file) in enumerate(places):
        there = pd.read_parquet(root / f"data/chunk-{chunk:03d}/file-{file:03d}.parquet", columns=["episode_index"])
        assert index in set(there["episode_index"])
    np.testing.assert_array_equal(loaded[5 * frames + 3]["action"].numpy(), made_up(5, frames).action[3])
    whole = write_dataset(tmp_path / "whole", provenance, [made_up(seed, frames) for seed in range(count)])
    assert whole.digest == made.digest


def test_the_same_episodes_are_the_same_bytes_in_any_process(tmp_path: Path) -> None:
    """LeRobot keeps names of columns in sets, whose order is another one in each process."""
    program = (
        "import sys; from pathlib import Path; from hdril.demonstrations.record import record;"
        "from hdril.demonstrations.provenance import Recipe; record(Recipe('table_lift'), 1, 5, Path(sys.argv[1]))"
    )
    for seed in ("1", "2"):
        variables = os.environ | {"PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", program, str(tmp_path / seed)]
        subprocess.run(command, check=True, env=variables, capture_output=True)
    assert listing(tmp_path / "1") == listing(tmp_path / "2")


def test_segments_go_from_start_to_start_ends_included(written: Written) -> None:
    row = LeRobotDataset("any/name", root=written[0]).meta.episodes[1]
    assert row["dense_subtask_names"] == ["move", "grasp", "move", "move"]
    assert row["dense_subtask_start_frames"] == [0, 2, 3, 4]
    assert row["dense_subtask_end_frames"] == [1, 2, 3, 4]


def test_every_episode_comes_with_its_scenario(written: Written) -> None:
    rows = LeRobotDataset("any/name", root=written[0]).meta.episodes
    scenarios = [Scenario.from_json(row["scenario"]) for row in rows]
    assert scenarios == [TASKS["table_lift"].sample(seed) for seed in (7, 9)]


def test_shares_of_the_primitives(written: Written) -> None:
    task = TASKS["table_lift"]
    shares = json.loads((written[0] / PROPORTIONS_PATH).read_text())
    assert list(shares) == list(task.labels)
    assert shares["grasp"] == pytest.approx(3 / 17)
    assert sum(shares.values()) == pytest.approx(1.0)


def test_an_episode_is_read_back(written: Written) -> None:
    root, episodes = written
    stored = read_episode(root, 1)
    np.testing.assert_array_equal(stored.state, episodes[1].state)
    np.testing.assert_array_equal(stored.action, episodes[1].action)
    assert stored.label is not None
    assert stored.label.tolist() == [1, 1, 0, 1, 1]
    assert stored.primitives == TASKS["table_lift"].labels
    assert stored.time == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert set(stored.signals) == {"observation.state", "observation.environment_state", "action"}
    signal = stored.signals["observation.state"]
    assert signal.names == ACTION_NAMES
    assert set(signal.positions()) == {"left_ee", "right_ee"}
    for index, side in enumerate(SIDES):
        np.testing.assert_array_equal(signal.positions()[f"{side}_ee"], hand_poses(episodes[1].state)[:, index, :3])


def test_positions_are_those_of_whole_poses() -> None:
    names = ("a.x", "a.y", "a.z", "b.y", "b.x", "b.z", *(f"b.q{axis}" for axis in "xyzw"), "alone")
    signal = Signal("observation.things", names, np.arange(22.0).reshape(2, 11))
    assert {name: values.tolist() for name, values in signal.positions().items()} == {"b": [[4, 3, 5], [15, 14, 16]]}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["p", "q"], ("p", "q")),
        ({"left": ["p"], "right": ["q"]}, ("p", "q")),
        (None, ("state.0", "state.1")),
        (["only one"], ("state.0", "state.1")),
    ],
)
def test_every_number_has_a_name(names, expected: tuple[str, ...]) -> None:
    assert feature_names("observation.state", {"names": names, "shape": [2]}) == expected


def test_what_is_not_there_is_named(written: Written, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="is no LeRobot dataset"):
        read_episode(tmp_path, 0)
    with pytest.raises(ValueError, match="has no episode 2; its episodes are 0 to 1"):
        read_episode(written[0], 2)
    with pytest.raises(ValueError, match=f"has no {SUBTASKS_PATH}"):
        read_primitives(tmp_path)
