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

from hdril import __version__
from hdril.cli.check import CheckConfig, check_command
from hdril.cli.record import RecordConfig, record_command
from hdril.demonstrations.check import check_dataset
from hdril.demonstrations.content import content, episode_digest
from hdril.demonstrations.frames import Finding
from hdril.demonstrations.provenance import RECIPE_PATH, Provenance, Recipe
from hdril.demonstrations.schema import SUBTASKS_PATH
from hdril.demonstrations.write import write_dataset

FRAMES = 70
"""Of each episode of the dataset."""
ROW, LATE = 2 * FRAMES + 5, 5 * FRAMES + 5
"""Frame 5 of episode 2, and of the last one."""
CHANGED = "its digest is not the one in meta/episodes: it was changed after it was recorded"

ChangeFrames = Callable[[pd.DataFrame], None]
ChangeTable = Callable[[pa.Table], pa.Table]


@pytest.fixture
def copy(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / "copy"))


def change(root: Path, folder: str, write: ChangeFrames) -> None:
    """Let ``write`` change the only table of a folder."""
    (file,) = (root / folder).rglob("*.parquet")
    schema, table = pq.read_schema(file), pd.read_parquet(file)
    write(table)
    pq.write_table(pa.Table.from_pandas(table, schema=schema, preserve_index=False), file)


def set_numbers(column: str, row: int, places: int | slice, value: float) -> ChangeFrames:
    """Sets numbers of a vector."""

    def write(table: pd.DataFrame) -> None:
        changed = table.at[row, column].copy()
        changed[places] = value
        table.at[row, column] = changed

    return write


def set_value(column: str, row: int, value: object) -> ChangeFrames:
    def write(table: pd.DataFrame) -> None:
        table.loc[row, column] = value

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


CASES: dict[str, tuple[ChangeFrames, Finding]] = {
    "nan": (
        set_numbers("observation.state", ROW, 2, np.nan),
        Finding("observation.state is not finite (left_ee.z)", 2, 5),
    ),
    "infinite": (set_numbers("action", ROW, 0, np.inf), Finding("action is not finite (left_ee.x)", 2, 5)),
    "unit": (
        set_numbers("observation.environment_state", ROW, 6, 1.1),
        Finding("the quaternion of observation.environment_state table is not of unit length", 2, 5),
    ),
    "no rotation": (
        set_numbers("action", ROW, slice(3, 7), 0.0),
        Finding("the quaternion of action left_ee is not of unit length", 2, 5),
    ),
    "sign": (flip, Finding("the quaternion of action left_ee changes its sign", 1, 30)),
    "too open": (set_numbers("action", ROW, 7, 1.2), Finding("a commanded opening is not from 0 to 1", 2, 5)),
    "too shut": (set_numbers("action", ROW, 15, -0.2), Finding("a commanded opening is not from 0 to 1", 2, 5)),
    "numbering": (set_value("frame_index", ROW, 9), Finding("frame_index does not count up from 0", 2, 5)),
    "index": (set_value("index", ROW, 0), Finding("index does not go on from 140", 2, 5)),
    "late": (set_value("timestamp", ROW, 7.0), Finding("timestamp is not frame_index / 10", 2, 5)),
    "early": (set_value("timestamp", ROW, 0.0), Finding("timestamp is not frame_index / 10", 2, 5)),
    "label": (
        set_value("subtask_index", ROW, 9),
        Finding("subtask_index is 9; meta/subtasks.parquet has 6 primitives", 2, 5),
    ),
    "start": (
        set_value("subtask_index", ROW, 3),
        Finding("subtask_index changes, and subtask_start is false, and in 1 more frame", 2, 5),
    ),
    "segments": (
        set_value("subtask_start", ROW, True),
        Finding("the segments dense_subtask_… of meta/episodes are not those of the frames", 2),
    ),
    "failure": (
        set_value("next.success", 3 * FRAMES - 1, False),
        Finding("next.success is false in the last frame", 2, FRAMES - 1),
    ),
    "done": (set_value("next.done", ROW, True), Finding("next.done is true before the last frame", 2, 5)),
}


@pytest.mark.parametrize("case", CASES)
def test_a_damage_is_found_where_it_is(case: str, copy: Path) -> None:
    damage, finding = CASES[case]
    change(copy, "data", damage)
    found = list(check_dataset(copy))
    assert finding in found
    # Places are LeRobot's and no content. What is not finite is not looked at any further.
    of_content = case not in ("numbering", "index", "late", "early", "nan", "infinite")
    assert (Finding(CHANGED, finding.episode) in found) == of_content
    assert {each.episode for each in found} == {finding.episode}


def test_a_command_out_of_reach_is_found(copy: Path) -> None:
    change(copy, "data", set_numbers("action", ROW, 2, 3.0))
    (found,) = (each for each in check_dataset(copy) if "reach" in each.text)
    assert (found.episode, found.frame) == (2, 5)
    assert found.text.startswith("the command of the left hand is out of reach by ")


def test_a_changed_number_is_found_by_the_digest_alone(copy: Path) -> None:
    change(copy, "data", set_numbers("action", ROW, 0, 0.5))
    assert list(check_dataset(copy)) == [Finding(CHANGED, 2)]


def test_lengths_are_those_of_the_table_of_episodes(copy: Path) -> None:
    change(copy, "meta/episodes", set_value("length", 3, 71))
    assert list(check_dataset(copy)) == [Finding("it has 70 frames; meta/episodes says 71", 3)]


def drop(table: pd.DataFrame) -> None:
    table.drop(table.index[table["episode_index"] == 2], inplace=True)


def test_what_is_missing_is_found_and_the_rest_keeps_its_number(copy: Path) -> None:
    change(copy, "data", drop)
    whole = f"the digest of all episodes is not the one in {RECIPE_PATH}"
    assert [str(found) for found in check_dataset(copy, None)] == ["episodes are missing: 2", whole]


# --------------------------------------------------------------------- files


def test_a_file_that_cannot_be_read_does_not_hide_the_others(copy: Path) -> None:
    """The first two episodes go to a file of their own, which is then cut short; another one has a bad frame."""
    change(copy, "data", set_numbers("action", ROW, 0, np.nan))
    (file,) = (copy / "data").rglob("*.parquet")
    table, head = pq.read_table(file), file.with_name("file-000.parquet")
    pq.write_table(table[2 * FRAMES :], file.with_name("file-001.parquet"))
    pq.write_table(table[: 2 * FRAMES], head)
    assert list(check_dataset(copy)) == [Finding("action is not finite (left_ee.x)", 2, 5)]
    head.write_bytes(head.read_bytes()[:1000])
    first, bad, missing, _ = check_dataset(copy)
    assert first.text.startswith("data/chunk-000/file-000.parquet cannot be read: ")
    assert (bad.episode, bad.frame) == (2, 5)
    assert str(missing) == "episodes are missing: 0, 1"


def test_the_table_of_episodes_cannot_be_read(copy: Path) -> None:
    (file,) = (copy / "meta/episodes").rglob("*.parquet")
    file.write_bytes(file.read_bytes()[:100])
    (finding,) = check_dataset(copy)
    assert finding.text.startswith("meta/episodes cannot be read: ")


def replaced(name: str, values: Callable[[list], list]) -> ChangeTable:
    """A column with other cells."""

    def write(table: pa.Table) -> pa.Table:
        cells = pa.array(values(table[name].to_pylist()))
        return table.set_column(table.column_names.index(name), name, cells)

    return write


def with_cell(row: int, cell: object) -> Callable[[list], list]:
    return lambda cells: [*cells[:row], cell, *cells[row + 1 :]]


FORMS: dict[str, tuple[ChangeTable, str]] = {
    # Some tools write numbers as lists of one number.
    **{
        f"{name} in lists": (replaced(name, lambda cells: [[cell] for cell in cells]), "")
        for name in ("episode_index", "frame_index", "index", "subtask_index", "subtask_start", "next.done")
    },
    "no labels": (
        lambda table: table.drop_columns("subtask_index"),
        "data/chunk-000/file-000.parquet lacks the columns subtask_index",
    ),
    "no reward": (
        lambda table: table.drop_columns("next.reward"),
        "episode 0: its digest cannot be checked: next.reward is missing",
    ),
    "narrow": (
        replaced("action", lambda cells: [cell[:15] for cell in cells]),
        "episode 0: action has 15 numbers; meta/info.json says 16",
    ),
    "ragged": (
        replaced("action", with_cell(ROW, [0.0, 0.0])),
        "episode 2: action cannot be read: all input arrays must have the same shape",
    ),
    "empty": (replaced("action", with_cell(ROW, None)), "episode 2: action cannot be read: a cell is empty"),
    "no label": (
        replaced("subtask_index", with_cell(ROW, None)),
        "episode 2: subtask_index cannot be read: a cell is empty",
    ),
    "nan for a label": (
        replaced("subtask_index", with_cell(ROW, float("nan"))),
        "episode 2, frame 5: subtask_index is empty",
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_columns_of_another_form_are_read_or_named(form: str, copy: Path) -> None:
    write, finding = FORMS[form]
    (file,) = (copy / "data").rglob("*.parquet")
    pq.write_table(write(pq.read_table(file)), file)
    found = [str(each) for each in check_dataset(copy)]
    assert finding in found if finding else not found


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"info\.json cannot be read: "),
        ('{"codebase_version": "v2.1", "features": {}, "fps": 10, "total_episodes": 1}', "of LeRobot's format v2.1"),
        ('{"codebase_version": "v3.0", "features": {}, "total_episodes": 1}', r"info\.json has no fps"),
    ],
)
def test_a_description_that_cannot_be_used_is_refused(text: str, message: str, copy: Path) -> None:
    (copy / "meta/info.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        next(check_dataset(copy))


def test_a_dataset_without_what_the_policy_needs_is_told_what(copy: Path) -> None:
    info = json.loads((copy / "meta/info.json").read_text())
    del info["features"]["subtask_index"]
    (copy / "meta/info.json").write_text(json.dumps(info))
    (finding,) = check_dataset(copy)
    assert finding.text.startswith("columns are missing: subtask_index; there are: observation.state, ")


def test_primitives_without_names(copy: Path) -> None:
    (copy / SUBTASKS_PATH).unlink()
    (finding,) = check_dataset(copy)
    assert finding.text.endswith(f"has no {SUBTASKS_PATH}: its primitives have no names")


def test_primitives_with_the_same_name(copy: Path) -> None:
    pd.DataFrame({"subtask_index": range(6)}, index=list("abacde")).to_parquet(copy / SUBTASKS_PATH)
    assert next(check_dataset(copy)) == Finding(f"{SUBTASKS_PATH} gives several primitives the same name")


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
    change(copy, "data", set_numbers("action", ROW, 0, np.nan))
    assert list(check_dataset(copy)) == [Finding("action is not finite (action.0)", 2, 5)]


def test_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"is no LeRobot dataset: it has no meta/info\.json"):
        next(check_dataset(tmp_path))


# --------------------------------------------------------------------- made again


def test_episodes_are_made_again_number_for_number(dataset: Path) -> None:
    told: list[tuple[str, int, int]] = []
    assert list(check_dataset(dataset, 2, progress=lambda *args: told.append(args))) == []
    assert told[-2:] == [("making again", 1, 2), ("making again", 2, 2)]


def test_an_episode_that_is_another_is_found_where_it_first_differs(copy: Path, capsys) -> None:
    change(copy, "data", set_numbers("action", LATE, 0, 0.5))
    with pytest.raises(SystemExit, match="1"):
        check_command(CheckConfig(copy, "2", show=1, workers=1))
    said = capsys.readouterr().out
    assert CHANGED in said
    assert "… and 1 more; --show=2 prints all" in said
    (again,) = (found for found in check_dataset(copy, 2) if "made again" in found.text)
    assert (again.episode, again.frame) == (5, 5)
    assert again.text.startswith("made again from recipe and seed, its action differs, first here, by up to ")


def shorten(table: pd.DataFrame) -> None:
    table.drop(table.index[-1], inplace=True)


def test_all_episodes_are_made_again_and_every_difference_counts(copy: Path, capsys) -> None:
    change(copy, "data", shorten)
    change(copy, "meta/episodes", set_value("scenario", 1, "{}"))
    recipe = json.loads((copy / RECIPE_PATH).read_text())
    recipe["recipe"]["hdril_version"] = "0.0.9"
    (copy / RECIPE_PATH).write_text(json.dumps(recipe))
    with pytest.raises(SystemExit, match="1"):
        check_command(CheckConfig(copy, "all", workers=1))
    said = [line for line in capsys.readouterr().out.splitlines() if "made again" in line or "may differ" in line]
    assert said == [
        f"hdril 0.0.9 recorded it, and {__version__} makes it again: it may differ",
        "episode 1: made again from recipe and seed, its scenario differs",
        "episode 5: made again from recipe and seed, it has 70 frames and not 69",
    ]


def test_record_verifies(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record_command(RecordConfig(verify=copy, num_episodes=1, workers=1))
    assert f"{copy}: nothing is wrong" in capsys.readouterr().out
    change(copy, "data", set_numbers("action", LATE, 0, 0.5))
    with pytest.raises(SystemExit, match="1"):
        record_command(RecordConfig(verify=copy, num_episodes=2, workers=1))
    assert "episode 5, frame 5: made again from recipe and seed" in capsys.readouterr().out
    with pytest.raises(ValueError, match="--verify records nothing: leave out seed, push"):
        record_command(RecordConfig(verify=copy, push=True, seed=7))
    with pytest.raises(ValueError, match="num_episodes must be at least 1, got 0"):
        record_command(RecordConfig(verify=copy, num_episodes=0))


def test_every_number_counts_for_a_digest(made_up) -> None:
    columns = content(made_up(1))
    digests = [episode_digest(columns, 1, "{}"), episode_digest(columns, 2, "{}"), episode_digest(columns, 1, "{ }")]
    for name, values in columns.items():
        changed = values.copy()
        changed.flat[-1] = not changed.flat[-1] if changed.dtype == bool else changed.flat[-1] + 1
        digests.append(episode_digest(columns | {name: changed}, 1, "{}"))
    digests.append(episode_digest(columns | {"action": columns["action"].astype(np.float64)}, 1, "{}"))
    digests.append(episode_digest(columns | {"action": columns["action"].reshape(-1, 8)}, 1, "{}"))
    assert len(set(digests)) == len(digests)


def test_digests_are_of_the_episodes_alone(made_up, tmp_path: Path) -> None:
    """Where an episode stands in a dataset does not count; for the whole, the order of the episodes does."""

    def digests(name: str, *seeds: int) -> tuple[list[str], str]:
        root = tmp_path / name
        made = write_dataset(root, Provenance(Recipe("table_lift"), seeds), [made_up(seed) for seed in seeds])
        return pd.read_parquet(root / "meta/episodes")["digest"].tolist(), made.digest

    (one, two), both = digests("a", 1, 2)
    (again,), alone = digests("b", 2)
    assert again == two != one
    assert len({both, alone, digests("c", 2, 1)[1]}) == 3
