"""Disturbances, as declared events: what happens to an episode, when, and how strongly.

Another package adds a kind of event with an :class:`EventKind` of its own, and an entry point of the group ``hdril.events``
that names it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from hdril.plugins import Registry
from hdril.simulation.disturbances import Disturbances
from hdril.tasks.factors import stream


@dataclass(frozen=True)
class Event:
    """Something that happens to an episode: it begins before the action of ``frame`` and takes ``frames`` frames."""

    name: str
    """The task's name for it."""
    kind: str
    """One of :data:`EVENT_KINDS`."""
    frame: int
    frames: int
    target: str
    """The body, the side of a hand or the joint that it happens to; empty for the sensor."""
    vector: tuple[float, ...] = ()
    """Its direction and strength, in the units of its kind."""

    def __str__(self) -> str:
        strength = math.hypot(*self.vector)
        amount = f" ({strength:.2f} {EVENT_KINDS[self.kind].unit})" if self.vector else ""
        return f"{self.name}{f': {self.target}' if self.target else ''}{amount}"


@dataclass(frozen=True)
class EventKind:
    """What events of one kind do to a running episode."""

    name: str
    begin: Callable[[Disturbances, Event], None]
    unit: str = ""
    """Of :attr:`Event.vector`."""


def _read(source: object) -> EventKind:
    if not isinstance(source, EventKind):
        raise TypeError(f"{source!r} is no hdril.tasks.events.EventKind")
    return source


_KINDS = (
    EventKind("push", lambda door, event: door.push(event.target, event.vector), "N s"),
    EventKind("slide", lambda door, event: door.slide(event.target, event.vector, event.frames), "m"),
    EventKind("open_hand", lambda door, event: door.open_hand(event.target, event.frames)),
    EventKind("stop_motor", lambda door, event: door.stop_motor(event.target, event.frames)),
    EventKind("freeze", lambda door, event: door.blind(event.frames)),
    EventKind("repeat", lambda door, event: door.blind(event.frames, every=3)),
)
EVENT_KINDS: Registry[EventKind] = Registry("event kind", "hdril.events", {kind.name: kind for kind in _KINDS}, _read)
"""Kinds of events by name."""


@dataclass(frozen=True)
class EventSpec:
    """An event that a task declares: its kind, its targets, and the ranges that it is drawn from.

    ``window`` and ``frames`` are ranges of whole frames, both ends included. ``strength`` is a range in the kind's unit; the
    direction is uniform in the horizontal plane.

    Raises:
        ValueError: an unknown kind, a range that ends before it begins, or a strength where the kind has none or none where it
            has one.
    """

    name: str
    kind: str
    window: tuple[int, int]
    targets: tuple[str, ...] = ("",)
    frames: tuple[int, int] = (1, 1)
    strength: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        needs_strength = bool(EVENT_KINDS.find(self.kind).unit)
        if needs_strength != (self.strength is not None):
            raise ValueError(
                f"event {self.name}: a {self.kind} {'needs a strength' if needs_strength else 'has no strength'}"
            )
        for what, (low, high), least in (("window", self.window, 0), ("frames", self.frames, 1)):
            if not least <= low <= high:
                raise ValueError(
                    f"event {self.name}: {what} must be from {least} on and not end before it begins, got {low} to {high}"
                )

    def sample(self, seed: int) -> Event:
        """The event in the episode of a seed."""
        rng = stream(seed, f"event {self.name}")
        frame, frames = (int(rng.integers(low, high + 1)) for low, high in (self.window, self.frames))
        target = self.targets[int(rng.integers(len(self.targets)))]
        vector: tuple[float, ...] = ()
        if self.strength is not None:
            size, angle = rng.uniform(*self.strength), rng.uniform(0.0, 2.0 * math.pi)
            vector = (float(size * math.cos(angle)), float(size * math.sin(angle)), 0.0)
        return Event(self.name, self.kind, frame, frames, target, vector)
