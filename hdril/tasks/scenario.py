"""Everything that a seed decides about an episode before it begins."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import Any

from hdril.geometry import Pose
from hdril.tasks.events import Event


@dataclass(frozen=True)
class Scenario:
    """A scene: the values of the factors that vary, where every body starts, and what will happen.

    With the task, it makes the same episode again, bit for bit; it is recorded with every episode.
    """

    task: str
    """The task's name, with its parameters."""
    seed: int
    """What the scene was sampled from. It also seeds the noise of the observation."""
    values: dict[str, float]
    """Values of the factors that vary, by key (:attr:`hdril.tasks.factors.Factor.keys`). Others are nominal."""
    poses: dict[str, tuple[float, ...]]
    """Where each body starts, (x, y, z, qx, qy, qz, qw) in the world, m."""
    events: tuple[Event, ...] = ()

    def pose(self, body: str) -> Pose:
        """Where a body starts."""
        return Pose.from_vector(self.poses[body])

    def without_events(self) -> Scenario:
        """The control: the same scene, in which nothing happens."""
        return replace(self, events=())

    def to_json(self) -> str:
        """One line of JSON. Floating-point numbers keep every bit."""
        return json.dumps(asdict(self), separators=(",", ":"))

    @staticmethod
    def from_json(text: str) -> Scenario:
        """The inverse of :meth:`to_json`.

        Raises:
            ValueError: the text is not that of a scenario.
        """
        try:
            fields: dict[str, Any] = json.loads(text)
            poses = {body: tuple(pose) for body, pose in fields["poses"].items()}
            events = tuple(Event(**event | {"vector": tuple(event["vector"])}) for event in fields["events"])
            return Scenario(fields["task"], fields["seed"], fields["values"], poses, events)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"not a scenario: {type(error).__name__}: {error}") from None
