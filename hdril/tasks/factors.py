"""What varies between the scenes of a task, as data: named factors with a range each."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

Kind = Literal["offset", "scale", "ratio", "level"]

_NOMINAL: dict[Kind, float] = {"offset": 0.0, "scale": 1.0, "ratio": 1.0, "level": 0.0}
_OFF: dict[Kind, float] = {"offset": 0.0, "scale": 0.0, "ratio": 1.0, "level": 0.0}


def stream(seed: int, name: str, attempt: int = 0) -> np.random.Generator:
    """Random numbers of their own for each name: what one factor or event draws does not depend on which others vary."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), attempt])


@dataclass(frozen=True)
class Factor:
    """Something that varies from scene to scene. Its range is one number, so that it can be set with a task's name.

    ========  ==============================================  =======
    kind      value for a range r                             nominal
    ========  ==============================================  =======
    offset    uniform in [-r, r]                              0
    scale     uniform in [1 - r, 1 + r]                       1
    ratio     log-uniform in [1 / r, r]                       1
    level     r itself: a strength that every scene has       0
    ========  ==============================================  =======
    """

    name: str
    kind: Kind
    span: float
    """The range at the levels ``varied`` and ``hard``, in ``unit``."""
    limit: float
    """The widest range that is accepted."""
    unit: str
    meaning: str
    """What varies, in words."""
    parts: tuple[str, ...] = ()
    """What it is drawn for, each on its own; once for the scene if empty."""

    @property
    def nominal(self) -> float:
        """The value where the factor does not vary."""
        return _NOMINAL[self.kind]

    @property
    def off(self) -> float:
        """The range that does not vary anything."""
        return _OFF[self.kind]

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of its values: ``yaw``, or ``yaw:left_half`` and ``yaw:right_half``."""
        return tuple(f"{self.name}:{part}" for part in self.parts) or (self.name,)

    def check(self, span: float) -> float:
        """The range, if it is one.

        Raises:
            ValueError: it is not between :attr:`off` and :attr:`limit`, or is a part of a frame.
        """
        if not self.off <= span <= self.limit:
            unit = f" {self.unit}" if self.unit else ""
            raise ValueError(f"{self.name} must be from {self.off:g} to {self.limit:g}{unit}, got {span:g}")
        if self.unit == "frames" and span != round(span):
            raise ValueError(f"{self.name} must be a whole number of frames, got {span:g}")
        return span

    def draw(self, span: float, seed: int, attempt: int = 0) -> dict[str, float]:
        """The factor's values in the scene of a seed, by key."""
        return {key: self._draw(span, stream(seed, key, attempt)) for key in self.keys}

    def _draw(self, span: float, rng: np.random.Generator) -> float:
        match self.kind:
            case "offset":
                return float(rng.uniform(-span, span))
            case "scale":
                return float(rng.uniform(1.0 - span, 1.0 + span))
            case "ratio":
                return math.exp(rng.uniform(-math.log(span), math.log(span)))
            case "level":
                return span


POSITION_NOISE = Factor(
    "position_noise", "level", 0.005, 0.05, "m", "standard deviation of each observed coordinate, at every frame"
)
ROTATION_NOISE = Factor(
    "rotation_noise", "level", 2.0, 20.0, "deg", "standard deviation of each observed rotation, at every frame"
)
DELAY = Factor("delay", "level", 1.0, 5.0, "frames", "frames by which the observed objects lag behind")
POSTURE = Factor("posture", "level", 0.1, 0.3, "rad", "largest offset of each arm joint from the posture at the start")
COMMON = (POSTURE, POSITION_NOISE, ROTATION_NOISE, DELAY)
"""Factors of the robot and of its observation, which every task has."""
