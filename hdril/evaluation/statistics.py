"""Intervals for success rates."""

from __future__ import annotations

import numpy as np
from statsmodels.stats.proportion import proportion_confint


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval for a proportion, in [0, 1].

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"an interval needs 0 <= successes <= trials and a trial, got {successes} of {trials}")
    interval = proportion_confint(successes, trials, alpha=1.0 - confidence, method="wilson")
    low, high = np.asarray(interval, dtype=np.float64).tolist()
    return low, high
