"""The episodes of a LeRobot dataset as they are stored, damaged or not, one file at a time in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hdril.demonstrations.content import CONTENT, Columns
from hdril.demonstrations.schema import ACTION, ENVIRONMENT_STATE, STATE, SUBTASK

if TYPE_CHECKING:
    import pandas as pd

VECTORS = (STATE, ENVIRONMENT_STATE, ACTION)
PLACES = ("episode_index", "frame_index", "index", "timestamp")
"""LeRobot's columns that say where a frame stands."""
REQUIRED = (*PLACES, *VECTORS, SUBTASK)


@dataclass(frozen=True)
class Finding:
    """Something that is wrong: in which episode and at which of its frames, or -1 where it is in none."""

    text: str
    episode: int = -1
    frame: int = -1

    def __str__(self) -> str:
        place = [f"episode {self.episode}"] if self.episode >= 0 else []
        place += [f"frame {self.frame}"] if self.frame >= 0 else []
        return f"{', '.join(place)}: {self.text}" if place else self.text


@dataclass(frozen=True)
class StoredFrames:
    """An episode as it is stored: its columns, and its row in the table of episodes, which is empty if there is none."""

    index: int
    columns: Columns
    row: Mapping[str, Any]
    first: int
    """Number of its first frame in the dataset."""

    def __len__(self) -> int:
        return len(self.columns["frame_index"])


def read_rows(root: Path) -> dict[int, dict[str, Any]]:
    """The table of episodes, by episode.

    Raises:
        ValueError: it cannot be read; says why.
    """
    import pandas as pd
    import pyarrow as arrow

    files = sorted((root / "meta/episodes").rglob("*.parquet"))
    try:
        rows = [row for file in files for row in pd.read_parquet(file).to_dict("records")]
        return {int(row["episode_index"]): {str(name): value for name, value in row.items()} for row in rows}
    except (OSError, ValueError, KeyError, TypeError, arrow.ArrowException) as error:
        raise ValueError(f"meta/episodes cannot be read: {error}") from error


def read_frames(
    root: Path, info: Mapping[str, Any], rows: Mapping[int, Mapping[str, Any]]
) -> Iterator[StoredFrames | Finding]:
    """The episodes of all files in order, and what is wrong with files and episodes that cannot be read.

    Args:
        root: folder of the dataset.
        info: content of ``meta/info.json``.
        rows: the table of episodes, by episode.
    """
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    start = 0
    for file in sorted((root / "data").rglob("*.parquet")):
        name = file.relative_to(root)
        try:
            there = parquet.read_schema(file).names
            if missing := [column for column in REQUIRED if column not in there]:
                yield Finding(f"{name} lacks the columns {', '.join(missing)}")
                continue
            # Not all columns: images may be among them.
            wanted = [column for column in dict.fromkeys((*REQUIRED, *CONTENT)) if column in there]
            table = parquet.read_table(file, columns=wanted).to_pandas(integer_object_nulls=True)
            episodes = _column(table["episode_index"])
        except (OSError, ValueError, arrow.ArrowException) as error:
            yield Finding(f"{name} cannot be read: {error}")
            continue
        for index in dict.fromkeys(episodes.tolist()):
            part = table[episodes == index]
            row = rows.get(index, {})
            first = int(row.get("dataset_from_index", start))
            found = _columns(part, info, index)
            yield found if isinstance(found, Finding) else StoredFrames(index, found, row, first)
            start = first + len(part)


def _columns(part: pd.DataFrame, info: Mapping[str, Any], index: int) -> Columns | Finding:
    """The columns of an episode, vectors as (T, N), or why they cannot be read."""
    columns = {}
    for name in part:
        try:
            columns[str(name)] = _column(part.loc[:, name])
        except ValueError as error:
            return Finding(f"{name} cannot be read: {error}", index)
    for name in VECTORS:
        columns[name] = columns[name].reshape(len(part), -1)
        width, told = columns[name].shape[1], info["features"][name]["shape"][0]
        if width != told:
            return Finding(f"{name} has {width} numbers; meta/info.json says {told}", index)
    return columns


def _column(values: pd.Series) -> NDArray[np.generic]:
    """(T,), or (T, N) where the cells are vectors of more than one number.

    Raises:
        ValueError: cells are empty or of different lengths.
    """
    array = values.to_numpy()
    if array.dtype == object:
        if any(cell is None for cell in array):
            raise ValueError("a cell is empty")
        array = np.stack([np.atleast_1d(cell) for cell in array])
        array = array[:, 0] if array.shape[1] == 1 else array
    return array
