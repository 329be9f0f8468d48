"""Read an episode of a LeRobot dataset, whoever recorded it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdril.demonstrations.schema import ACTION, STATE, SUBTASK, SUBTASKS_PATH
from hdril.geometry import POSE_AXES


@dataclass(frozen=True)
class Signal:
    """A vector of the dataset over an episode of T frames."""

    key: str
    names: tuple[str, ...]
    values: NDArray[np.float64]  # (T, N)

    def positions(self) -> dict[str, NDArray[np.float64]]:
        """Positions (T, 3), m, of every pose among the numbers (``<name>.x`` to ``<name>.qw``), by the pose's name."""
        column = {name: index for index, name in enumerate(self.names)}
        prefixes = dict.fromkeys(name.rpartition(".")[0] for name in self.names)
        poses = {prefix: [column.get(f"{prefix}.{axis}", -1) for axis in POSE_AXES] for prefix in prefixes}
        return {prefix: self.values[:, columns[:3]] for prefix, columns in poses.items() if -1 not in columns}


@dataclass(frozen=True)
class StoredEpisode:
    """An episode of T frames as a dataset holds it: all vectors of observation and action, and its labels if it has any."""

    time: NDArray[np.float64]  # (T,), s
    signals: dict[str, Signal]
    label: NDArray[np.int64] | None  # (T,)
    primitives: tuple[str, ...]
    """Names of the primitives, by label; empty without labels."""

    @property
    def state(self) -> NDArray[np.float64]:
        """Measured hand poses and openings (T, 16) of a dataset that hdril recorded."""
        return self.signals[STATE].values

    @property
    def action(self) -> NDArray[np.float64]:
        """Commanded hand poses and openings (T, 16) of a dataset that hdril recorded."""
        return self.signals[ACTION].values


def read_info(root: Path) -> dict[str, Any]:
    """What ``meta/info.json`` of a dataset says.

    Raises:
        FileNotFoundError: there is no dataset at ``root``.
        ValueError: the file is damaged, or of another format than LeRobot's version 3; names it.
    """
    path = root / "meta/info.json"
    if not path.exists():
        raise FileNotFoundError(f"{root} is no LeRobot dataset: it has no meta/info.json")
    try:
        info = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if missing := [name for name in ("codebase_version", "features", "fps", "total_episodes") if name not in info]:
        raise ValueError(f"{path} has no {missing[0]}")
    if not str(info["codebase_version"]).startswith("v3."):
        raise ValueError(f"{path} is of LeRobot's format {info['codebase_version']}; hdril reads v3.0")
    return info


def read_episode(root: Path, episode: int) -> StoredEpisode:
    """The frames of an episode, in order.

    Raises:
        FileNotFoundError: there is no dataset at ``root``.
        ValueError: it has no such episode, or does not name its labels.
    """
    import pandas as pd

    info = read_info(root)
    frames = pd.read_parquet(root / "data", filters=[("episode_index", "==", episode)]).sort_values("frame_index")
    if frames.empty:
        raise ValueError(f"{root} has no episode {episode}; its episodes are 0 to {info['total_episodes'] - 1}")
    labelled = SUBTASK in frames
    return StoredEpisode(
        time=frames["timestamp"].to_numpy(dtype=np.float64),
        signals={
            key: Signal(key, feature_names(key, feature), np.stack(list(frames[key])).astype(np.float64))
            for key, feature in info["features"].items()
            if _is_signal(key, feature)
        },
        label=frames[SUBTASK].to_numpy(dtype=np.int64) if labelled else None,
        primitives=read_primitives(root) if labelled else (),
    )


def _is_signal(key: str, feature: Mapping[str, Any]) -> bool:
    wanted = key == ACTION or key.startswith("observation.")
    return wanted and feature["dtype"] in ("float32", "float64") and len(feature["shape"]) == 1


def feature_names(key: str, feature: Mapping[str, Any]) -> tuple[str, ...]:
    """One name per number of a feature. A dataset may list them, group them in a dict, or not name them at all."""
    names = feature.get("names") or []
    if isinstance(names, Mapping):
        names = [name for group in names.values() for name in group]
    count = feature["shape"][0]
    if len(names) == count:
        return tuple(map(str, names))
    return tuple(f"{key.rpartition('.')[2]}.{i}" for i in range(count))


def read_primitives(root: Path) -> tuple[str, ...]:
    """Names of the primitives, by label.

    Raises:
        ValueError: the dataset does not name its labels.
    """
    import pandas as pd

    path = root / SUBTASKS_PATH
    if not path.exists():
        raise ValueError(f"{root} has no {SUBTASKS_PATH}: its primitives have no names")
    table = pd.read_parquet(path).sort_values(SUBTASK)
    names = table["subtask"] if "subtask" in table.columns else table.index
    return tuple(map(str, names))
