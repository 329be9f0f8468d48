"""A dataset whose labels are LeRobot's language rows: the policy learns from it what it learns from numbers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot_policy_hdril.schema import SUBTASKS_PATH

from tests.policies.tools import BATCH, build, demonstrations, observation, read


def in_words(root: Path, output: Path, names: list[str], keep_names: bool = False) -> Path:
    """A copy of the dataset whose labels are in words alone, as LeRobot's annotation tool leaves them."""
    shutil.copytree(root, output)
    (file,) = (output / "data").rglob("*.parquet")
    table = pq.read_table(file)
    columns = [table[name].to_pylist() for name in ("episode_index", "subtask_start", "subtask_index", "timestamp")]
    rows: dict[int, list[dict]] = {}
    for episode, start, label, time in zip(*columns, strict=True):
        if start:
            row = {"role": "assistant", "content": names[label], "style": "subtask", "timestamp": time,
                   "camera": None, "tool_calls": None}  # fmt: skip
            rows.setdefault(episode, []).append(row)
    plan = {
        "role": "assistant",
        "content": "lift it",
        "style": "plan",
        "timestamp": 0.0,
        "camera": None,
        "tool_calls": None,
    }
    cells = pa.array([[plan, *reversed(rows[episode])] for episode in columns[0]])
    table = table.drop_columns(["subtask_index", "subtask_start"]).append_column("language_persistent", cells)
    pq.write_table(table, file)
    info = json.loads((output / "meta/info.json").read_text())
    del info["features"]["subtask_index"], info["features"]["subtask_start"]
    info["features"]["language_persistent"] = {"dtype": "language", "shape": [1], "names": None}
    (output / "meta/info.json").write_text(json.dumps(info))
    if not keep_names:
        (output / SUBTASKS_PATH).unlink()
    return output


NAMES = ["grasp", "move", "lift", "extend", "place", "retract"]


@pytest.mark.parametrize("keep_names", [False, True])
def test_words_teach_what_numbers_teach(keep_names: bool, metadata, tmp_path: Path) -> None:
    worded = read(in_words(Path(metadata.root), tmp_path / "words", NAMES, keep_names))
    numbers, words = build(metadata), build(worded)
    assert words.config.primitives == numbers.config.primitives
    assert words.config.primitive_lengths == numbers.config.primitive_lengths
    for name in ("label", "segment", "state"):
        assert torch.equal(getattr(demonstrations(words), name), getattr(demonstrations(numbers), name)), name
    assert words.forward({"index": BATCH})[1] == numbers.forward({"index": BATCH})[1]
    seen = observation(metadata, [0, 70])
    assert torch.equal(words.eval().select_action(seen), numbers.eval().select_action(seen))


def test_words_count_where_the_names_of_numbers_are_older(metadata, tmp_path: Path) -> None:
    root = in_words(Path(metadata.root), tmp_path / "words", [*NAMES[:2], "fly", *NAMES[3:]], keep_names=True)
    assert build(read(root)).config.primitives == ["grasp", "move", "extend", "place", "retract", "fly"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: [], "episode 0: language_persistent has no row of the style 'subtask'"),
        (lambda rows: rows[:-1], "episode 0: its rows .* must begin with the first frame"),
        (lambda rows: [*rows, rows[-1]], "episode 0: its rows .* and no two at the same"),
    ],
)
def test_words_that_label_nothing_are_refused(change, message: str, metadata, tmp_path: Path) -> None:
    root = in_words(Path(metadata.root), tmp_path / "words", NAMES)
    (file,) = (root / "data").rglob("*.parquet")
    table = pq.read_table(file)
    rows = [change(cell) for cell in table["language_persistent"].to_pylist()]
    place = table.column_names.index("language_persistent")
    pq.write_table(table.set_column(place, "language_persistent", pa.array(rows)), file)
    with pytest.raises(ValueError, match=message):
        build(read(root))
