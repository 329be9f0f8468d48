"""The expert's episodes, which the policies' are compared with."""

from __future__ import annotations

from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hdril.digest import digest_file, digest_json
from hdril.env import BimanualEnv
from hdril.evaluation.software import episode_software
from hdril.files import cache_folder, read_arrays, write_atomically
from hdril.rollout import Ending
from hdril.tasks import DETAILED, Task, base_name, task_parameters
from hdril.tasks.expert import ScriptedExpert
from hdril.tasks.primitives import Noise
from hdril.trace import Trace, trace_episode


@dataclass(frozen=True)
class Reference:
    """What an episode is compared with: the noise-free expert's episode on the same seed."""

    state: NDArray[np.float32]  # (T + 1, 16)
    objects: NDArray[np.float64]  # (T + 1, observed bodies, 7), where they were, without noise or delay
    scripted: NDArray[np.int64]  # (T,), labels
    success: bool
    """Whether the expert itself solves this scene. Where it does not, errors against it say nothing about a policy."""
    unmet: str
    """The conditions of success that the expert misses; empty if there are none."""

    @staticmethod
    def of(task: Task, trace: Trace, ending: Ending) -> Reference:
        """The reference that an episode of the expert makes."""
        return Reference(trace.state, observed_poses(task, trace), trace.scripted, ending.success, ending.unmet)


def observed_poses(task: Task, trace: Trace) -> NDArray[np.float64]:
    """Poses (T + 1, observed bodies, 7), m, without noise or delay."""
    return np.stack([trace.poses[name] for name in task.observed], axis=1)


class ReferenceCache:
    """The expert's episodes of a task on disk, by seed: several policies on the same seeds need each of them once.

    They lie in ``$XDG_CACHE_HOME/hdril/expert`` (``~/.cache`` unless set), under a digest of the task, of the sources that
    decide an episode, and of the simulator's and the robot model's versions: where one of them differs, they are played anew.
    What of the scene a policy observes is no part of it: the expert is shown all.
    """

    def __init__(self, task: str) -> None:
        # An environment of its own: that of the policy may cut episodes later, where the expert has no more to do.
        self._env = BimanualEnv(task)
        self._expert = ScriptedExpert(self._env.task_spec, Noise(0.0))
        made_by = episode_software(base_name(task)) | {"reference": digest_file(Path(__file__))}
        parameters = {name: value for name, value in task_parameters(task).items() if name != DETAILED}
        digest = digest_json([base_name(task), parameters, made_by])
        self._folder = cache_folder() / "expert" / digest[:16]

    def get(self, seed: int) -> Reference:
        """The expert's episode of this seed, played now unless it is there."""
        path = self._folder / f"{seed}.npz"
        # A cache that is damaged or cannot be written costs time and nothing else.
        with suppress(OSError, ValueError, KeyError):
            data = read_arrays(path)
            return Reference(
                data["state"],
                data["objects"],
                data["scripted"],
                bool(data["success"]),
                str(data["unmet"]),
            )
        with closing(self._env):
            reference = Reference.of(self._env.task_spec, *trace_episode(self._env, self._expert, seed))
        with suppress(OSError):
            write_atomically(path, lambda file: np.savez(file, allow_pickle=False, **vars(reference)))
        return reference
