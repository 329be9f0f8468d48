"""What an episode of a dataset says, apart from where it stands: the same wherever, and with whom, it was recorded."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from hdril.demonstrations.episode import Episode
from hdril.demonstrations.schema import (
    ACTION,
    DONE,
    ENVIRONMENT_STATE,
    REWARD,
    STATE,
    SUBTASK,
    SUBTASK_START,
    SUCCESS,
)

Columns = Mapping[str, NDArray[np.generic]]
"""Frames (T,) or (T, N) of an episode by column."""

CONTENT = (STATE, ENVIRONMENT_STATE, ACTION, SUBTASK, SUBTASK_START, REWARD, SUCCESS, DONE)
"""The columns that a demonstration decides. LeRobot's others number the frames."""


def content(episode: Episode) -> dict[str, NDArray[np.generic]]:
    """The columns :data:`CONTENT` of an episode."""
    last = np.arange(len(episode)) == len(episode) - 1
    return {
        STATE: episode.state,
        ENVIRONMENT_STATE: episode.environment_state,
        ACTION: episode.action,
        SUBTASK: episode.label,
        SUBTASK_START: episode.start,
        REWARD: episode.reward,
        SUCCESS: last & episode.success,
        DONE: last,
    }


def episode_digest(columns: Columns, seed: int, scenario: str) -> str:
    """SHA-256, in hexadecimal, of the columns :data:`CONTENT` bit for bit, the seed and the scenario."""
    digest = hashlib.sha256(f"{seed}\n{scenario}\n".encode())
    for name in CONTENT:
        values = np.ascontiguousarray(columns[name])
        values = values.astype(values.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def dataset_digest(episodes: Iterable[str]) -> str:
    """SHA-256, in hexadecimal, of the digests of a dataset's episodes, in order."""
    return hashlib.sha256("".join(f"{digest}\n" for digest in episodes).encode()).hexdigest()
