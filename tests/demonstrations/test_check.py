"""hdril-check: what is wrong with a dataset is found, in its episode and at its frame."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hdril.cli.check import CheckConfig, check_command
from hdril.cli.record import RecordConfig, record_command
from hdril.demonstrations.check import Finding, check_dataset
from hdril.demonstrations.provenance import RECIPE_PATH, Provenance, Recipe
from hdril.demonstrations.schema import SUBTASKS_PATH
from hdril.demonstrations.write import write_dataset

FRAMES = 70
"""Of each episode of the dataset."""
CHANGED = "its content has another digest than meta/episodes says: it was changed after it was recorded"


@pytest.fixture
def copy(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / "copy"))


def change(root: Path, folder: str, write: Callable[[pd.DataFrame], None]) -> None:
    """Let ``write`` change the only table of a folder."""
    (file,) = (root / folder).rglob("*.parquet")
    schema, table = pq.read_schema(file), pd.read_parquet(file)
    write(table)
    pq.write_table(pa.Table.from_pandas(table, schema=schema, preserve_index=False), file)


def set_number(column: str, row: int, place: int, value: float) -> Callable[[pd.DataFrame], None]:
    """Sets one number of a vector."""

    def write(table: pd.DataFrame) -> None:
        changed = table.at[row, column].copy()
        changed[place] = value
        table.at[row, column] = changed

    return write


def set_value(column: str, rows: list[int], value: object) -> Callable[[pd.DataFrame], None]:
    def write(table: pd.DataFrame) -> None:
        table.loc[rows, column] = value

    return write


def flip(table: pd.DataFrame) -> None:
    """The left hand's quaternion, from frame 30 of episode 1 on, with the other sign: the same rotation."""
    for row in range(FRAMES + 30, 2 * FRAMES):
        changed = table.at[row, "action"].copy()
        changed[3:7] *= -1.0
        table.at[row, "action"] = changed


def test_nothing_is_wrong_with_what_was_recorded(dataset: Path) -> None:
    told: list[tuple[str, int, int]] = []
    assert list(check_dataset(dataset, progress=lambda *args: told.append(args))) == []
    assert told == [("checking", i, 6) for i in range(1, 7)]


ROW = 2 * FRAMES + 5
CASES: dict[str, tuple[Callable[[pd.DataFrame], None], Finding]] = {
    "nan": (
        set_number("observation.state", ROW, 2, np.nan),
        Finding("observation.state is not finite (left_ee.z)", 2, 5),
    ),
    "infinite": (set_number("action", ROW, 0, np.inf), Finding("action is not finite (left_ee.x)", 2, 5)),
    "unit": (
        set_number("observation.environment_state", ROW, 6, 1.1),
        Finding("the quaternion of observation.environment_state table is not of unit length", 2, 5),
    ),
    "sign": (flip, Finding("the quaternion of action left_ee changes its sign", 1, 30)),
    "opening": (set_number("action", ROW, 7, 1.2), Finding("a commanded opening is not from 0 to 1", 2, 5)),
    "numbering": (set_value("frame_index", [ROW], 9), Finding("frame_index does not count up from 0", 2, 5)),
    "index": (set_value("index", [ROW], 0), Finding("index does not go on from 140", 2, 5)),
    "time": (set_value("timestamp", [ROW], 7.0), Finding("timestamp is not frame_index / 10", 2, 5)),
    "label": (
        set_value("subtask_index", [ROW], 9),
        Finding("subtask_index is 9; meta/subtasks.parquet has 6 primitives", 2, 5),
    ),
    "start": (
        set_value("subtask_index", [ROW], 3),
        Finding("subtask_index changes, and subtask_start is false, and at 1 more frames", 2, 5),
    ),
    "segments": (
        set_value("subtask_start", [ROW], True),
        Finding("the segments dense_subtask_… of meta/episodes are not those of the frames", 2),
    ),
    "failure": (
        set_value("next.success", [3 * FRAMES - 1], False),
        Finding("next.success is false in the last frame", 2, FRAMES - 1),
    ),
    "done": (set_value("next.done", [ROW], True), Finding("next.done is true before the last frame", 2, 5)),
}


@pytest.mark.parametrize("case", CASES)
def test_a_damage_is_found_where_it_is(case: str, copy: Path) -> None:
    damage, finding = CASES[case]
    change(copy, "data", damage)
    found = list(check_dataset(copy))
    assert finding in found
    of_content = case not in ("numbering", "index", "time", "nan", "infinite")
    assert (Finding(CHANGED, finding.episode) in found) == of_content
    assert {each.episode for each in found} == {finding.episode}


def test_a_command_out_of_reach_is_found(copy: Path) -> None:
    change(copy, "data", set_number("action", ROW, 2, 3.0))
    (found,) = (each for each in check_dataset(copy) if "reach" in each.text)
    assert (found.episode, found.frame) == (2, 5)
    assert found.text.startswith("the left hand does not reach its command, by ")


def test_a_changed_number_is_found_by_the_digest_alone(copy: Path) -> None:
    change(copy, "data", set_number("action", ROW, 0, 0.5))
    assert list(check_dataset(copy)) == [Finding(CHANGED, 2)]


def drop(table: pd.DataFrame) -> None:
    table.drop(table.index[table["episode_index"] == 5], inplace=True)


def test_what_is_missing_is_found(copy: Path) -> None:
    change(copy, "data", drop)
    assert [str(found) for found in check_dataset(copy)] == [
        "there are 350 frames; meta/info.json says 420",
        "there are 5 episodes; meta/info.json says 6",
        f"there are 5 episodes; {RECIPE_PATH} has 6 seeds",
        f"the digest of the episodes is not the one in {RECIPE_PATH}: some are missing or others",
    ]


def test_files_that_cannot_be_read_are_named(copy: Path) -> None:
    (file,) = (copy / "data").rglob("*.parquet")
    file.write_bytes(file.read_bytes()[:1000])
    first = next(check_dataset(copy))
    assert first.text.startswith(f"{file.relative_to(copy)} cannot be read: ")


def test_a_dataset_without_what_the_policy_needs_is_told_what(copy: Path) -> None:
    info = json.loads((copy / "meta/info.json").read_text())
    del info["features"]["subtask_index"]
    (copy / "meta/info.json").write_text(json.dumps(info))
    (finding,) = check_dataset(copy)
    assert finding.text.startswith("there is no column subtask_index; there are: observation.state, ")


def test_primitives_without_names(copy: Path) -> None:
    (copy / SUBTASKS_PATH).unlink()
    assert [found.text for found in check_dataset(copy)] == [
        f"there is no {SUBTASKS_PATH}: the primitives have no names"
    ]


def test_a_dataset_that_hdril_did_not_record(copy: Path) -> None:
    """No recipe, no seeds, no digests, other names for the numbers: the rest is checked all the same."""
    (copy / RECIPE_PATH).unlink()
    own = ["subtask_start", "dense_subtask_names", "dense_subtask_start_frames", "dense_subtask_end_frames", "digest",
           "scenario", "seed"]  # fmt: skip
    for folder in ("data", "meta/episodes"):
        (file,) = (copy / folder).rglob("*.parquet")
        table = pq.read_table(file)
        pq.write_table(table.drop_columns([name for name in own if name in table.column_names]), file)
    info = json.loads((copy / "meta/info.json").read_text())
    del info["features"]["subtask_start"]
    info["features"]["action"]["names"] = None
    (copy / "meta/info.json").write_text(json.dumps(info))
    assert list(check_dataset(copy)) == []
    with pytest.raises(ValueError, match=rf"has no {RECIPE_PATH}: its episodes cannot be made again"):
        next(check_dataset(copy, 1))
    change(copy, "data", set_number("action", ROW, 0, np.nan))
    assert list(check_dataset(copy)) == [Finding("action is not finite (action.0)", 2, 5)]


def test_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"is no LeRobot dataset: it has no meta/info\.json"):
        next(check_dataset(tmp_path))


# --------------------------------------------------------------------- made again


def test_episodes_are_made_again_bit_for_bit(dataset: Path) -> None:
    told: list[tuple[str, int, int]] = []
    assert list(check_dataset(dataset, 2, progress=lambda *args: told.append(args))) == []
    assert told[-2:] == [("making again", 1, 2), ("making again", 2, 2)]


def test_an_episode_that_is_another_is_found_from_the_frame_on(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(copy, "data", set_number("action", ROW, 0, 0.5))
    with pytest.raises(SystemExit, match="1"):
        check_command(CheckConfig(copy, "3", show=1, workers=1))
    said = capsys.readouterr().out
    assert CHANGED in said
    assert "… and 1 more; --show=2 prints all" in said
    (again,) = (found for found in check_dataset(copy, 3) if "made again" in found.text)
    assert (again.episode, again.frame) == (2, 5)
    assert again.text.startswith("made again from its recipe and seed, it has another action from here on, by up to ")


def test_record_verifies(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record_command(RecordConfig(verify=copy, num_episodes=1, workers=1))
    assert f"{copy}: nothing is wrong" in capsys.readouterr().out
    with pytest.raises(ValueError, match="--verify records nothing: leave out --push and --root"):
        record_command(RecordConfig(verify=copy, push=True, repo_id="a/b"))


def test_digests_are_of_the_episodes_alone(made_up, tmp_path: Path) -> None:
    """Where an episode stands in a dataset does not count; seed and every number do."""

    def digests(name: str, *seeds: int) -> tuple[list[str], str]:
        root = tmp_path / name
        made = write_dataset(root, Provenance(Recipe("table_lift"), seeds), [made_up(seed) for seed in seeds])
        return pd.read_parquet(root / "meta/episodes")["digest"].tolist(), made.digest

    (one, two), both = digests("a", 1, 2)
    (again,), alone = digests("b", 2)
    assert again == two != one
    assert len({both, alone, digests("c", 2, 1)[1]}) == 3
