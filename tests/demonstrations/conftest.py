"""Episodes of made-up numbers, for what does not need a simulation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hdril.demonstrations.episode import Episode


@pytest.fixture(scope="session")
def made_up() -> Callable[..., Episode]:
    """``made_up(seed, frames=12, success=True)``: an episode of table lift whose numbers depend on the seed alone."""

    def make(seed: int, frames: int = 12, success: bool = True, label: list[int] | None = None) -> Episode:
        rng = np.random.default_rng(seed)
        return Episode(
            seed=seed,
            state=rng.normal(size=(frames, 16)).astype(np.float32),
            environment_state=rng.normal(size=(frames, 7)).astype(np.float32),
            action=rng.normal(size=(frames, 16)).astype(np.float32),
            label=np.array(label) if label else np.arange(frames) * 6 // frames,
            reward=rng.uniform(size=frames).astype(np.float32),
            success=success,
            unmet="" if success else "table upright",
        )

    return make
