"""A recipe that cannot be played. Worker processes import this module, so it imports little."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass

from hdril.demonstrations.provenance import Recipe
from hdril.env import BimanualEnv


@dataclass(frozen=True)
class Broken(Recipe):
    """A recipe whose environment cannot be made: by a bug, or because the process is killed."""

    killed: bool = False

    def make_env(self) -> BimanualEnv:
        if self.killed:
            os.kill(os.getpid(), signal.SIGKILL)
        raise KeyError("no body 'chair'")
