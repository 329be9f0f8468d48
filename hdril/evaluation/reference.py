"""The expert's episodes, which the policies' are compared with."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hdril
from hdril.env import BimanualEnv
from hdril.files import cache_folder, write_atomically
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.trace import Trace, trace_episode


@dataclass(frozen=True)
class Reference:
    """What an episode is compared with: the noise-free expert's episode on the same seed."""

    state: NDArray[np.float32]  # (T + 1, 16)
    environment_state: NDArray[np.float32]  # (T + 1, 7 per object)
    scripted: NDArray[np.int64]  # (T,), labels

    @staticmethod
    def of(trace: Trace) -> Reference:
        return Reference(trace.state, trace.environment_state, trace.scripted)


class ReferenceCache:
    """The expert's episodes on disk, by seed: several policies on the same seeds need each of them once.

    They lie in ``$XDG_CACHE_HOME/hdril/expert`` (``~/.cache`` unless set), under a digest of the task and of this
    package's source: another version of the code plays them anew.
    """

    def __init__(self, env: BimanualEnv) -> None:
        self._env, self._expert = env, ScriptedExpert(env.task_spec, Noise(0.0))
        digest = hashlib.sha256(env.task.encode())
        for file in sorted(Path(hdril.__file__).parent.rglob("*.py")):
            digest.update(file.read_bytes())
        self._folder = cache_folder() / "expert" / digest.hexdigest()[:16]

    def get(self, seed: int) -> Reference:
        """The expert's episode of this seed, played now unless it is there."""
        path = self._folder / f"{seed}.npz"
        if path.exists():
            with np.load(path) as data:
                return Reference(**data)
        reference = Reference.of(trace_episode(self._env, self._expert, seed)[0])
        write_atomically(path, lambda file: np.savez(file, allow_pickle=False, **vars(reference)))
        return reference
