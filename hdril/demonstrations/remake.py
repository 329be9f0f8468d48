"""Episodes of a dataset made again from recipe and seed, and compared with what is stored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing

import numpy as np

from hdril import __version__
from hdril.demonstrations.content import content
from hdril.demonstrations.episode import Episode
from hdril.demonstrations.frames import Finding, StoredFrames
from hdril.demonstrations.provenance import Provenance
from hdril.demonstrations.record import play
from hdril.demonstrations.schema import SCENARIO


def choose(count: int, wanted: int | None) -> list[int]:
    """``wanted`` of ``count`` episodes, spread from the first to the last; None: all."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return np.unique(np.linspace(0, count - 1, wanted).astype(int)).tolist()


def compare_with_remade(
    stored: Sequence[StoredFrames],
    provenance: Provenance,
    workers: int,
    progress: Callable[[str, int, int], None] | None,
) -> Iterator[Finding]:
    """What differs where episodes are made again: number for number, with no tolerance."""
    if provenance.hdril_version != __version__:
        yield Finding(f"hdril {provenance.hdril_version} recorded it, and {__version__} makes it again: it may differ")
    with closing(play(provenance.recipe, [provenance.seeds[old.index] for old in stored], workers)) as again:
        for done, (old, new) in enumerate(zip(stored, again, strict=True), 1):
            if found := _difference(old, new):
                frame, text = found
                yield Finding(f"made again from recipe and seed, {text}", old.index, frame)
            if progress:
                progress("making again", done, len(stored))


def _difference(old: StoredFrames, new: Episode) -> tuple[int, str] | None:
    """The first column that differs, and at which frame it first does."""
    if old.row.get(SCENARIO, new.scenario) != new.scenario:
        return -1, "its scenario differs"
    if len(old) != len(new):
        return -1, f"it has {len(new)} frames and not {len(old)}"
    for name, now in content(new).items():
        before = old.columns.get(name, now)
        if before.shape != now.shape:
            return -1, f"its {name} is of shape {now.shape} and not {before.shape}"
        wrong = (before != now).reshape(len(now), -1).any(1)
        if wrong.any():
            gap = np.abs(before.astype(np.float64) - now.astype(np.float64)).max()
            return int(wrong.argmax()), f"its {name} differs, first here, by up to {gap:.2g}"
    return None
