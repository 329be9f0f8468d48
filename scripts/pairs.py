"""Paired tests of two evaluations that are kept as summaries in the JSON of a document."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hdril.evaluation.statistics import mcnemar_exact, most_discordant, paired_counts


@dataclass(frozen=True)
class PValue:
    """p of McNemar's exact test. It is an upper bound unless ``exact``."""

    value: float
    exact: bool

    def text(self, adjusted: float) -> str:
        """``p = 0.03`` or ``p ≤ 0.03`` with an adjusted value, to two digits; ``p < 0.001`` below that."""
        if adjusted < 0.001:
            return "p < 0.001"
        return f"p {'=' if self.exact else '≤'} {adjusted:.2g}"


def summarise(results: Mapping[str, Any]) -> dict[str, Any]:
    """What a document keeps of ``results.json``. ``failed_seeds`` lets the report pair two policies seed by seed."""
    # Without paths, which mean nothing on another machine.
    left_out = ("per_episode", "policy", "policy_folder", "comparison")
    kept = {key: value for key, value in results.items() if key not in left_out}
    return kept | {"failed_seeds": [episode["seed"] for episode in results["per_episode"] if not episode["success"]]}


def paired_p_value(first: Mapping[str, Any], second: Mapping[str, Any]) -> PValue:
    """Compare two evaluations on the same seeds.

    A summary has ``first_seed``, ``n_episodes`` and ``n_success``, and ``failed_seeds`` if hdril was new enough when it was
    made. Without it, p is the largest that the numbers of successes allow; that is exact if one of them is all or nothing.

    Raises:
        ValueError: the seeds are not the same.
    """
    trials = first["n_episodes"]
    if (first["first_seed"], trials) != (second["first_seed"], second["n_episodes"]):
        raise ValueError("paired outcomes need the same seeds")
    if "failed_seeds" in first and "failed_seeds" in second:
        return PValue(mcnemar_exact(paired_counts(_outcomes(first), _outcomes(second))), exact=True)
    successes = first["n_success"], second["n_success"]
    known = any(count in (0, trials) for count in successes)
    return PValue(mcnemar_exact(most_discordant(*successes, trials)), exact=known)


def _outcomes(summary: Mapping[str, Any]) -> dict[int, bool]:
    """Success by seed."""
    seeds = range(summary["first_seed"], summary["first_seed"] + summary["n_episodes"])
    failed = set(summary["failed_seeds"])
    return {seed: seed not in failed for seed in seeds}
