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
from hdril.rollout import Ending
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.trace import Trace, trace_episode


@dataclass(frozen=True)
class Reference:
    """What an episode is compared with: the noise-free expert's episode on the same seed."""

    state: NDArray[np.float32]  # (T + 1, 16)
    environment_state: NDArray[np.float32]  # (T + 1, 7 per object)
    scripted: NDArray[np.int64]  # (T,), labels
    success: bool
    """Whether the expert itself solves this scene. Where it does not, errors against it say nothing about a policy."""
    unmet: str
    """The conditions of success that the expert misses; empty if there are none."""

    @staticmethod
    def of(trace: Trace, ending: Ending) -> Reference:
        """The reference that an episode of the expert makes."""
        return Reference(trace.state, trace.environment_state, trace.scripted, ending.success, ending.unmet)


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
                return Reference(
                    data["state"], data["environment_state"], data["scripted"], bool(data["success"]), str(data["unmet"])
                )
        reference = Reference.of(*trace_episode(self._env, self._expert, seed))
        write_atomically(path, lambda file: np.savez(file, allow_pickle=False, **vars(reference)))
        return reference
