"""Labels of primitives: as numbers, in words, and from one to the other."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from hdril.cli.labels import LabelsConfig, labels_command
from hdril.demonstrations.check import check_dataset
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.labels import add_words, check_forms, convert, labels_of, language_rows, subtasks_of
from hdril.demonstrations.provenance import Provenance, Recipe
from hdril.demonstrations.record import record
from hdril.demonstrations.schema import SUBTASKS_PATH
from hdril.demonstrations.write import write_dataset


@pytest.fixture
def numbered(made_up: Callable[..., Episode], tmp_path: Path) -> Path:
    """Two episodes of made-up numbers; the second plays a primitive three times, twice in a row."""
    again = made_up(9, frames=5, label=[1, 1, 0, 1, 1])
    again.start[4] = True
    write_dataset(tmp_path / "numbered", Provenance(Recipe("table_lift"), (7, 9)), [made_up(7), again])
    return tmp_path / "numbered"


def read(root: Path) -> pd.DataFrame:
    return pd.read_parquet(root / "data")


def annotate(root: Path, output: Path) -> Path:
    """What LeRobot's annotation tool leaves: labels in words alone, declared as before; here without the names of numbers."""
    convert(root, "language", output)
    (file,) = (output / "data").rglob("*.parquet")
    pq.write_table(pq.read_table(file).drop_columns(["subtask_index", "subtask_start"]), file)
    (output / SUBTASKS_PATH).unlink()
    return output


def test_words_say_what_begins_when(numbered: Path, tmp_path: Path) -> None:
    convert(numbered, "language", tmp_path / "words")
    loaded = LeRobotDataset("a/b", root=tmp_path / "words")
    assert loaded.meta.has_language_columns
    rows = loaded[14]["language_persistent"]
    assert rows == loaded[12]["language_persistent"]
    assert [(row["content"], row["style"], row["role"], row["camera"]) for row in rows] == [
        (name, "subtask", "assistant", None) for name in ("move", "grasp", "move", "move")
    ]
    assert [row["timestamp"] for row in rows] == pytest.approx([0.0, 0.2, 0.3, 0.4])
    assert [content for _, content in subtasks_of(loaded[0]["language_persistent"])] == [
        "grasp", "move", "lift", "extend", "place", "retract",
    ]  # fmt: skip


def test_there_and_back_is_the_same(numbered: Path, tmp_path: Path) -> None:
    words = annotate(numbered, tmp_path / "words")
    convert(words, "subtask_index", tmp_path / "back")
    before, after = read(numbered), read(tmp_path / "back")
    assert after["subtask_index"].tolist() == before["subtask_index"].tolist()
    assert after["subtask_start"].tolist() == before["subtask_start"].tolist()
    names = pd.read_parquet(tmp_path / "back" / SUBTASKS_PATH)
    assert list(names.index) == ["grasp", "move", "lift", "extend", "place", "retract"], "as they first appear"
    LeRobotDataset("a/b", root=tmp_path / "back")[0]
    changed = [str(found) for found in check_dataset(tmp_path / "back") if "digest" in found.text]
    assert changed == [], "the content is what was recorded"


def test_known_names_keep_their_numbers(numbered: Path, tmp_path: Path) -> None:
    words = annotate(numbered, tmp_path / "words")
    names = ["retract", "place", "extend", "lift", "move", "grasp"]
    pd.DataFrame({"subtask_index": range(6)}, index=names).to_parquet(words / SUBTASKS_PATH)
    labels_command(LabelsConfig(words, "subtask_index", tmp_path / "back"))
    assert (read(tmp_path / "back")["subtask_index"] == 5 - read(numbered)["subtask_index"]).all()


def test_words_count_where_the_names_of_numbers_are_older(numbered: Path, tmp_path: Path, capsys) -> None:
    """Somebody annotated anew: with a word that had no number, and without some that had one."""
    words = annotate(numbered, tmp_path / "words")
    shutil.copy(numbered / SUBTASKS_PATH, words / SUBTASKS_PATH)
    rewrite(words, language_rows(["fly", "move", "grasp"], [0.0, 0.1, 0.3]))
    labels_command(LabelsConfig(words, "subtask_index", tmp_path / "back"))
    assert capsys.readouterr().out.endswith("back has labels in subtask_index, too: grasp, move, fly\n")
    back = read(tmp_path / "back")["subtask_index"].tolist()
    assert back == [2, 1, 1] + [0] * 9 + [2, 1, 1, 0, 0]


def test_recorded_in_both_forms(tmp_path: Path) -> None:
    made = record(Recipe("table_lift"), 2, 60, tmp_path / "both", words=True)
    alone = record(Recipe("table_lift"), 2, 60, tmp_path / "numbers")
    assert made == alone, "the digest is of the numbers"
    assert list(check_dataset(tmp_path / "both")) == []
    rows = LeRobotDataset("a/b", root=tmp_path / "both")[75]["language_persistent"]
    assert [row["content"] for row in rows] == ["grasp", "move", "lift", "extend", "place", "retract"]


def rewrite(root: Path, rows: list[dict]) -> None:
    (file,) = (root / "data").rglob("*.parquet")
    table = pq.read_table(file).drop_columns("language_persistent")
    pq.write_table(table.append_column("language_persistent", pa.array([rows] * len(table))), file)


def test_a_conversion_leaves_what_is_not_its_own(numbered: Path, tmp_path: Path) -> None:
    """A recording to the same place may be unfinished."""
    (tmp_path / "words.partial").mkdir()
    (tmp_path / "words.partial/7.npz").write_bytes(b"an episode")
    convert(numbered, "language", tmp_path / "words")
    assert (tmp_path / "words.partial/7.npz").read_bytes() == b"an episode"


def test_a_label_without_a_name_is_told(numbered: Path, tmp_path: Path) -> None:
    pd.DataFrame({"subtask_index": range(2)}, index=["grasp", "move"]).to_parquet(numbered / SUBTASKS_PATH)
    with pytest.raises(ValueError, match="episode 0: labels go from 0 to 5, and 2 have names"):
        convert(numbered, "language", tmp_path / "words")
    assert [path.name for path in tmp_path.iterdir()] == ["numbered"]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (language_rows(["grasp"], [0.2]), "episode 0: rows of the style 'subtask' must begin with the first frame"),
        (language_rows(["grasp", "move", "lift"], [0.0, 0.05, 0.08]), "episode 0: .* and no two at the same"),
        (language_rows(["grasp", "move"], [0.0, 9.0]), "episode 0: rows of the style 'subtask' must begin"),
        ([language_rows(["grasp"], [0.0])[0] | {"style": "plan"}], "episode 0: rows of the style 'subtask' must begin"),
    ],
)
def test_words_that_label_nothing_are_refused(rows: list[dict], message: str, numbered: Path, tmp_path: Path) -> None:
    words = annotate(numbered, tmp_path / "words")
    shutil.copy(numbered / SUBTASKS_PATH, words / SUBTASKS_PATH)
    rewrite(words, rows)
    with pytest.raises(ValueError, match=message):
        convert(words, "subtask_index", tmp_path / "back")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["numbered", "words"]


def test_what_is_there_or_missing_is_told(numbered: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has a column subtask_index already"):
        convert(numbered, "subtask_index", tmp_path / "new")
    words = annotate(numbered, tmp_path / "words")
    with pytest.raises(ValueError, match="has a column language_persistent already"):
        convert(words, "language", tmp_path / "new")
    with pytest.raises(FileExistsError, match="choose another output"):
        convert(words, "subtask_index", numbered)
    (file,) = (words / "data").rglob("*.parquet")
    pq.write_table(pq.read_table(file).drop_columns("language_persistent"), file)
    with pytest.raises(ValueError, match="has no column language_persistent to take the labels from"):
        convert(words, "subtask_index", tmp_path / "new")


def test_files_keep_a_row_group_for_each_episode(numbered: Path) -> None:
    (file,) = (numbered / "data").rglob("*.parquet")
    before = pq.ParquetFile(file).num_row_groups
    add_words(numbered)
    assert pq.ParquetFile(file).num_row_groups == before == 2


def test_labels_at_times_that_were_rounded() -> None:
    """Times of frames are float32 in LeRobot's files, those of rows may be float64."""
    time = (np.arange(30) / 10).astype(np.float32)
    label, start = labels_of([(0.0, "a"), (0.7, "b"), (float(time[21]), "a")], time, ["a", "b"])
    assert label.tolist() == [0] * 7 + [1] * 14 + [0] * 9
    assert np.flatnonzero(start).tolist() == [0, 7, 21]


def test_forms() -> None:
    assert check_forms("subtask_index, language,language") == ("subtask_index", "language")
    with pytest.raises(ValueError, match="labels must be of subtask_index, language, got ''"):
        check_forms("")
