"""Success rates: intervals, paired comparisons of two policies on the same seeds, and the spread over trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import hypot, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval for a proportion, in [0, 1].

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"an interval needs 0 <= successes <= trials and a trial, got {successes} of {trials}")
    from statsmodels.stats.proportion import proportion_confint  # here: it takes a second to import

    interval = proportion_confint(successes, trials, alpha=1.0 - confidence, method="wilson")
    low, high = np.asarray(interval, dtype=np.float64).tolist()
    return low, high


@dataclass(frozen=True)
class PairedCounts:
    """Seeds by the outcomes of two policies on them.

    Raises:
        ValueError: a negative count, or no seeds.
    """

    both: int
    """Seeds on which both succeeded."""
    first_only: int
    second_only: int
    neither: int

    def __post_init__(self) -> None:
        if min(vars(self).values()) < 0 or self.trials < 1:
            raise ValueError(f"counts of pairs must be at least 0 and not all 0, got {self}")

    @property
    def trials(self) -> int:
        return self.both + self.first_only + self.second_only + self.neither

    @property
    def difference(self) -> float:
        """Success rate of the first policy minus that of the second, in [-1, 1]."""
        return (self.first_only - self.second_only) / self.trials


def paired_counts(first: Mapping[int, bool], second: Mapping[int, bool]) -> PairedCounts:
    """Counts from success by seed.

    Raises:
        ValueError: the seeds differ, or there are none.
    """
    if first.keys() != second.keys():
        apart = sorted(first.keys() ^ second.keys())
        raise ValueError(
            f"paired outcomes need the same seeds; {len(apart)} are in one of the two alone, e.g. {apart[0]}"
        )
    pairs = [(first[seed], second[seed]) for seed in first]
    return PairedCounts(*(pairs.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False))))


def mcnemar_exact(counts: PairedCounts) -> float:
    """p-value of McNemar's exact two-sided test of equal success rates; 1 if no seed tells the policies apart.

    With b and c the discordant counts, p = min(1, 2 P(X <= min(b, c))) for X ~ Binomial(b + c, 1/2). McNemar (1947), "Note
    on the sampling error of the difference between correlated proportions or percentages", in its exact form.
    """
    from statsmodels.stats.contingency_tables import mcnemar

    result: Any = mcnemar([[counts.both, counts.first_only], [counts.second_only, counts.neither]], exact=True)
    return float(result.pvalue)


def paired_difference_interval(counts: PairedCounts, confidence: float = 0.95) -> tuple[float, float]:
    """Interval for :attr:`PairedCounts.difference`, in [-1, 1].

    Newcombe's method 10, from Wilson's intervals (l, u) of both rates p and the correlation phi of the outcomes:
    lower = d - sqrt((p1 - l1)^2 - 2 phi (p1 - l1)(u2 - p2) + (u2 - p2)^2), upper likewise with the policies exchanged.
    Newcombe (1998), "Improved confidence intervals for the difference between binomial proportions based on paired data",
    Statistics in Medicine 17, 2635-2650.
    """
    first, second = counts.both + counts.first_only, counts.both + counts.second_only
    p1, p2 = first / counts.trials, second / counts.trials
    l1, u1 = wilson_interval(first, counts.trials, confidence)
    l2, u2 = wilson_interval(second, counts.trials, confidence)
    phi = _correlation(counts)
    return (
        counts.difference - _combine(p1 - l1, u2 - p2, phi),
        counts.difference + _combine(u1 - p1, p2 - l2, phi),
    )


def _combine(a: float, b: float, phi: float) -> float:
    """sqrt(a^2 - 2 phi a b + b^2)."""
    return sqrt(max(hypot(a, b) ** 2 - 2.0 * phi * a * b, 0.0))


def _correlation(counts: PairedCounts) -> float:
    """phi of method 10: a positive covariance is reduced by a continuity correction, down to 0 at most."""
    first, second, n = counts.both + counts.first_only, counts.both + counts.second_only, counts.trials
    margins = float(first * (n - first) * second * (n - second))
    if margins == 0.0:
        return 0.0
    covariance = float(counts.both * counts.neither - counts.first_only * counts.second_only)
    return (max(covariance - n / 2.0, 0.0) if covariance > 0.0 else covariance) / sqrt(margins)


def bootstrap_difference(
    first: NDArray[np.bool_],
    second: NDArray[np.bool_],
    confidence: float = 0.95,
    resamples: int = 10_000,
    same_trainings: bool = False,
) -> tuple[float, float]:
    """Percentile interval for the difference of two mean success rates over trainings and seeds, in [-1, 1].

    Trainings of each policy are drawn anew with replacement, and so are seeds, the same for both policies: a two-level
    bootstrap. Davison and Hinkley (1997), *Bootstrap Methods and their Application*, section 3.8. With few trainings it is too
    narrow: two or three show hardly more of how trainings differ than one does. :func:`difference_over_trainings` mends that.

    Args:
        first: (trainings, seeds) outcomes.
        second: (trainings, seeds) outcomes on the same seeds; the number of trainings may be another.
        confidence: of the interval.
        resamples: how many; the random numbers are always the same.
        same_trainings: both are of the same trained policies, in the same order, and these are drawn for both at once.

    Raises:
        ValueError: no outcomes, or the seeds differ in number, or the trainings do where they are the same.
    """
    if first.size == 0 or second.size == 0 or first.shape[1] != second.shape[1]:
        raise ValueError(f"paired outcomes need trainings and the same seeds, got {first.shape} and {second.shape}")
    if same_trainings and len(first) != len(second):
        raise ValueError(f"the same trainings must be as many, got {len(first)} and {len(second)}")
    rng, seeds = np.random.default_rng(0), first.shape[1]

    def shares(count: int) -> NDArray[np.float64]:
        return rng.multinomial(count, np.full(count, 1.0 / count), resamples) / count

    if same_trainings:
        by_seed = shares(len(first)) @ (first.astype(np.float64) - second)
    else:
        by_seed = shares(len(first)) @ first - shares(len(second)) @ second
    differences = (by_seed * shares(seeds)).sum(axis=1)
    low, high = np.quantile(differences, [(1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0]).tolist()
    return low, high


def student_difference(
    first: NDArray[np.bool_], second: NDArray[np.bool_], confidence: float = 0.95, same_trainings: bool = False
) -> tuple[float, float]:
    """Student's interval for the difference of two mean success rates over trainings, the seeds being given, in [-1, 1].

    It takes the success rates of trainings as normal, and as spread alike for both policies. For equal methods of which this is
    true it is exact on these seeds, however few the trainings. The arguments are those of :func:`bootstrap_difference`; at least
    two trainings of each.
    """
    from statsmodels.stats.weightstats import CompareMeans, DescrStatsW

    rates = first.mean(axis=1), second.mean(axis=1)
    if same_trainings:
        interval = DescrStatsW(rates[0] - rates[1]).tconfint_mean(1.0 - confidence)
    else:
        interval = CompareMeans(*map(DescrStatsW, rates)).tconfint_diff(1.0 - confidence, usevar="pooled")
    low, high = np.clip(np.asarray(interval, dtype=np.float64), -1.0, 1.0).tolist()
    return low, high


def difference_over_trainings(
    first: NDArray[np.bool_],
    second: NDArray[np.bool_],
    confidence: float = 0.95,
    resamples: int = 10_000,
    same_trainings: bool = False,
) -> tuple[float, float]:
    """Interval for the difference of two mean success rates, in [-1, 1], from as many trainings of each policy.

    One training has that of :func:`paired_difference_interval`. Several have the smallest that contains these three: that of
    :func:`bootstrap_difference`; :func:`student_difference`, because the bootstrap is too narrow where trainings are few; and
    the mean one of the pairs of trainings, because the bootstrap is a single number where all succeed on all seeds, although so
    many seeds leave a difference of some points open. The arguments are those of :func:`bootstrap_difference`.

    Raises:
        ValueError: no outcomes, or the seeds or the trainings differ in number.
    """
    pairs = [
        paired_counts(dict(enumerate(a)), dict(enumerate(b)))
        for a, b in zip(first.tolist(), second.tolist(), strict=True)
    ]
    low, high = np.mean([paired_difference_interval(counts, confidence) for counts in pairs], axis=0).tolist()
    if len(pairs) == 1:
        return low, high
    bounds = [
        (low, high),
        bootstrap_difference(first, second, confidence, resamples, same_trainings),
        student_difference(first, second, confidence, same_trainings),
    ]
    return min(bound for bound, _ in bounds), max(bound for _, bound in bounds)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for as many tests, in the same order: each p below alpha rejects at a familywise error of alpha.

    Holm (1979), "A simple sequentially rejective multiple test procedure".
    """
    from statsmodels.stats.multitest import multipletests

    return np.asarray(multipletests(p_values, method="holm")[1]).tolist() if p_values else []


@dataclass(frozen=True)
class TrainingSpread:
    """Success of several trainings, each evaluated on the same ``trials`` seeds.

    They are not pooled: the seeds are the same, and trainings differ by more than chance does.

    Raises:
        ValueError: no trainings, or more successes than trials.
    """

    successes: tuple[int, ...]
    """One number a training."""
    trials: int

    def __post_init__(self) -> None:
        if not self.successes or self.trials < 1 or not all(0 <= s <= self.trials for s in self.successes):
            raise ValueError(f"each training needs from 0 to {self.trials} successes, got {list(self.successes)}")

    @property
    def rates(self) -> tuple[float, ...]:
        """Success rate of each training, in [0, 1]."""
        return tuple(successes / self.trials for successes in self.successes)

    @property
    def mean(self) -> float:
        return float(np.mean(self.rates))

    @property
    def sd(self) -> float:
        """Standard deviation over trainings (n - 1 in the denominator); 0 for a single one."""
        return float(np.std(self.rates, ddof=1)) if len(self.rates) > 1 else 0.0

    def __str__(self) -> str:
        """Number of trainings × seeds, mean, range and SD in percent: ``3 × 200: 98.2 % (94.5 to 100.0, SD 3.2)``."""
        low, high = min(self.rates), max(self.rates)
        return (
            f"{len(self.rates)} × {self.trials}: {100 * self.mean:.1f} % "
            f"({100 * low:.1f} to {100 * high:.1f}, SD {100 * self.sd:.1f})"
        )
