"""Labels of primitives in LeRobot's two forms, and from one to the other.

``subtask_index`` gives each frame a number, which ``meta/subtasks.parquet`` names. ``language_persistent`` holds, in every frame
of an episode, all rows of the episode: a row of the style ``subtask`` says what begins at its time and goes on until the next.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hdril.demonstrations.read import read_info, read_primitives
from hdril.demonstrations.schema import LANGUAGE, SUBTASK, SUBTASK_START, SUBTASKS_PATH
from hdril.demonstrations.write import write_primitives
from hdril.files import write_atomically

NUMBERS, WORDS = "subtask_index", "language"
FORMS = (NUMBERS, WORDS)
"""Names of the forms."""
_COLUMNS = {NUMBERS: SUBTASK, WORDS: LANGUAGE}
_ROWS = pa.list_(
    pa.struct(
        {"role": pa.string(), "content": pa.string(), "style": pa.string(), "timestamp": pa.float32(),
         "camera": pa.string(), "tool_calls": pa.list_(pa.string())}
    )
)  # fmt: skip
"""As LeRobot reads them. Its own type of a tool call, JSON, cannot be made of Python's lists."""
STYLE = "subtask"
"""Of the rows that say which primitive plays."""


def check_forms(text: str) -> tuple[str, ...]:
    """The forms in a list like ``subtask_index,language``.

    Raises:
        ValueError: one that there is not, or none; names those there are.
    """
    forms = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    if unknown := [form for form in forms if form not in FORMS]:
        raise ValueError(f"labels must be of {', '.join(FORMS)}, got {unknown[0]!r}")
    return forms


def forms_of(root: Path) -> tuple[str, ...]:
    """The forms in which the frames of a dataset are labelled, in the order of :data:`FORMS`."""
    # Not info.json: LeRobot's annotation tool drops the column and leaves its declaration.
    there = {name for file in _files(root) for name in pq.read_schema(file).names}
    return tuple(form for form in FORMS if _COLUMNS[form] in there)


def language_rows(names: Sequence[str], times: Sequence[float]) -> list[dict[str, Any]]:
    """Rows of :data:`~hdril.demonstrations.schema.LANGUAGE` that say what begins at which time, s."""
    empty = {"camera": None, "tool_calls": None}
    return [
        {"role": "assistant", "content": name, "style": STYLE, "timestamp": float(time)} | empty
        for name, time in zip(names, times, strict=True)
    ]


def subtasks_of(rows: Sequence[Mapping[str, Any]] | None) -> list[tuple[float, str]]:
    """When each primitive begins, s, and its name, from the rows of an episode."""
    mine = [row for row in rows or () if row["style"] == STYLE and row["content"]]
    return sorted((float(row["timestamp"]), str(row["content"])) for row in mine)


def labels_of(
    subtasks: Sequence[tuple[float, str]], time: NDArray[np.floating], primitives: Sequence[str]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Labels (T,), and whether a primitive starts at each frame (T,), from when each begins.

    Raises:
        ValueError: no primitive begins at the first frame, two begin at the same one, or one is not among ``primitives``.
    """
    frames = np.searchsorted(time, np.array([at for at, _ in subtasks]) - 1e-4)  # float32 or float64
    if not len(frames) or frames[0] > 0 or frames[-1] >= len(time) or (np.diff(frames) <= 0).any():
        raise ValueError(f"rows of the style {STYLE!r} must begin with the first frame, and no two at the same")
    starts = np.zeros(len(time), np.bool_)
    starts[frames] = True
    numbers = np.array([primitives.index(name) for _, name in subtasks], np.int64)
    return numbers[np.cumsum(starts) - 1], starts


def add_words(root: Path) -> None:
    """Add :data:`~hdril.demonstrations.schema.LANGUAGE` to a dataset that has labels as numbers.

    Raises:
        ValueError: the labels have no names.
    """
    primitives = read_primitives(root)

    def add(episode: pa.Table) -> pa.Table:
        label, time = episode[SUBTASK].to_numpy(), episode["timestamp"].to_numpy()
        if label.min() < 0 or label.max() >= len(primitives):
            where = f"{root}, episode {episode['episode_index'][0]}"
            raise ValueError(
                f"{where}: labels go from {label.min()} to {label.max()}, and {len(primitives)} have names"
            )
        starts = np.diff(label, prepend=-1) != 0
        if SUBTASK_START in episode.column_names:
            starts |= episode[SUBTASK_START].to_numpy()
        rows = language_rows([primitives[number] for number in label[starts]], time[starts].tolist())
        return _set_column(episode, LANGUAGE, pa.array([rows] * len(episode), _ROWS))

    _rewrite(root, add, {LANGUAGE: {"dtype": "language", "shape": [1], "names": None}})


def add_numbers(root: Path) -> None:
    """Add ``subtask_index``, ``subtask_start`` and ``meta/subtasks.parquet`` to a dataset that has labels in words.

    The words are what counts, because ``meta/subtasks.parquet`` may be older: those that it names come first, in its order, then
    the others as they first appear. Names that no word has are left out, because nothing can be learned of them.

    Raises:
        ValueError: an episode has no rows of the style ``subtask``, or such that cannot be; names it.
    """
    tables = (pq.read_table(file, columns=[LANGUAGE])[LANGUAGE] for file in _files(root))
    rows = (cell.as_py() for column in tables for cell in column)
    words = dict.fromkeys(name for row in rows for _, name in subtasks_of(row))
    named = read_primitives(root) if (root / SUBTASKS_PATH).exists() else ()
    primitives = [name for name in dict.fromkeys((*named, *words)) if name in words]

    def add(episode: pa.Table) -> pa.Table:
        try:
            label, start = labels_of(
                subtasks_of(episode[LANGUAGE][0].as_py()), episode["timestamp"].to_numpy(), primitives
            )
        except ValueError as error:
            raise ValueError(f"{root}, episode {episode['episode_index'][0]}: {error}") from None
        return _set_column(_set_column(episode, SUBTASK, pa.array(label)), SUBTASK_START, pa.array(start))

    scalar = {"shape": [1], "names": None}
    _rewrite(root, add, {SUBTASK: {"dtype": "int64"} | scalar, SUBTASK_START: {"dtype": "bool"} | scalar})
    write_primitives(root, primitives)


def convert(root: Path, form: str, output: Path) -> None:
    """A copy of the dataset at ``root``, to which a form of labels is added.

    Raises:
        FileExistsError: there is something at ``output``.
        FileNotFoundError: there is no dataset at ``root``.
        ValueError: the dataset has this form already, or not the other; or its labels cannot be converted.
    """
    read_info(root)
    there = forms_of(root)
    (other,) = set(FORMS) - {form}
    if form in there:
        raise ValueError(f"{root} has a column {_COLUMNS[form]} already")
    if other not in there:
        raise ValueError(f"{root} has no column {_COLUMNS[other]} to take the labels from")
    if output.exists():
        raise FileExistsError(f"{output} exists; choose another output or delete it")
    output.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(dir=output.parent, prefix=f".{output.name}."))
    partial = made / "copy"
    try:
        shutil.copytree(root, partial)
        {NUMBERS: add_numbers, WORDS: add_words}[form](partial)
        partial.replace(output)
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _files(root: Path) -> list[Path]:
    return sorted((root / "data").rglob("*.parquet"))


def _set_column(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    if name in table.column_names:
        return table.set_column(table.column_names.index(name), name, values)
    return table.append_column(name, values)


def _rewrite(root: Path, add: Callable[[pa.Table], pa.Table], features: dict[str, dict[str, Any]]) -> None:
    """Write each data file anew, a row group for each episode as LeRobot has it, and declare the features."""
    for file in _files(root):
        table = pq.read_table(file)
        # What HF's datasets keeps in the schema does not know the new columns.
        table = table.replace_schema_metadata(None)
        first = np.flatnonzero(np.diff(table["episode_index"].to_numpy(), prepend=-1) != 0).tolist()
        parts = [add(table[a:b]) for a, b in pairwise([*first, len(table)])]

        def write(stream: IO[bytes], parts: list[pa.Table] = parts) -> None:
            with pq.ParquetWriter(stream, parts[0].schema) as writer:
                for part in parts:
                    writer.write_table(part)

        write_atomically(file, write)
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"] |= features
    write_atomically(path, lambda stream: stream.write(json.dumps(info, indent=4).encode()))
