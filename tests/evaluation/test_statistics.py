"""Intervals, paired tests, and the spread over trainings."""

from __future__ import annotations

from dataclasses import astuple
from math import comb, sqrt

import numpy as np
import pytest

from hdril.evaluation.statistics import (
    PairedCounts,
    TrainingSpread,
    bootstrap_difference,
    difference_over_trainings,
    holm,
    mcnemar_exact,
    paired_counts,
    paired_difference_interval,
    student_difference,
    wilson_interval,
)

Z = 1.959963984540054
TABLES = [
    PairedCounts(*counts) for counts in ((36, 12, 2, 0), (150, 20, 8, 22), (60, 3, 3, 34), (5, 0, 9, 6), (3, 1, 2, 1))
]


def exchanged(counts: PairedCounts) -> PairedCounts:
    return PairedCounts(counts.both, counts.second_only, counts.first_only, counts.neither)


def wilson_by_hand(k: int, n: int, z: float = Z) -> tuple[float, float]:
    p, scale = k / n, 1 + z * z / n
    middle = (p + z * z / (2 * n)) / scale
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / scale
    return middle - half, middle + half


@pytest.mark.parametrize(("k", "n"), [(0, 10), (97, 100), (120, 120), (1, 1)])
def test_wilson_interval_matches_its_formula(k: int, n: int) -> None:
    assert wilson_interval(k, n) == pytest.approx(wilson_by_hand(k, n), abs=1e-9)
    assert wilson_interval(k, n, confidence=0.6826894921) == pytest.approx(wilson_by_hand(k, n, 1.0), abs=1e-6)


@pytest.mark.parametrize(("k", "n"), [(0, 0), (3, 2), (-1, 5)])
def test_impossible_counts_have_no_interval(k: int, n: int) -> None:
    with pytest.raises(ValueError, match=f"got {k} of {n}"):
        wilson_interval(k, n)


# ---------------------------------------------------------------------- pairs


def test_pairs_are_counted_by_seed() -> None:
    first = {1: True, 2: True, 3: False, 4: False, 5: True, 6: True}
    second = {6: True, 5: False, 4: False, 3: True, 2: False, 1: False}
    assert paired_counts(first, second) == PairedCounts(both=1, first_only=3, second_only=1, neither=1)
    assert paired_counts(first, second).trials == 6
    assert paired_counts(first, second).difference == pytest.approx(2 / 6)


def test_each_kind_of_pair_has_a_count_of_its_own() -> None:
    kinds = [(True, True)] * 2 + [(True, False)] * 3 + [(False, True)] * 5 + [(False, False)] * 7
    first, second = ({seed: kind[i] for seed, kind in enumerate(kinds)} for i in range(2))
    assert paired_counts(first, second) == PairedCounts(both=2, first_only=3, second_only=5, neither=7)


def test_outcomes_of_other_seeds_are_not_pairs() -> None:
    with pytest.raises(ValueError, match=r"2 are in one of the two alone, e\.g\. 1"):
        paired_counts({1: True, 2: True}, {2: True, 3: True})
    with pytest.raises(ValueError, match="not all 0"):
        paired_counts({}, {})
    with pytest.raises(ValueError, match="at least 0"):
        PairedCounts(3, -1, 2, 4)


@pytest.mark.parametrize(("b", "c"), [(1, 0), (6, 0), (12, 2), (7, 5)])
def test_mcnemar_is_twice_the_binomial_tail_of_the_discordant_pairs(b: int, c: int) -> None:
    tail = sum(comb(b + c, k) for k in range(min(b, c) + 1)) / 2 ** (b + c)
    for concordant in ((10, 3), (0, 0)):
        counts = PairedCounts(concordant[0], b, c, concordant[1])
        assert mcnemar_exact(counts) == pytest.approx(min(1.0, 2 * tail))
        assert mcnemar_exact(exchanged(counts)) == mcnemar_exact(counts)


@pytest.mark.parametrize("counts", [PairedCounts(10, 0, 0, 3), PairedCounts(4, 5, 5, 1)])
def test_policies_that_no_pair_tells_apart_have_p_one(counts: PairedCounts) -> None:
    assert mcnemar_exact(counts) == 1.0


def test_difference_interval_is_newcombes() -> None:
    """Tables of Newcombe (1998) have 0.0569 to 0.3404 for 36, 12, 2, 0 by method 10."""
    assert paired_difference_interval(TABLES[0]) == pytest.approx((0.0569, 0.3404), abs=5e-5)


@pytest.mark.parametrize(("z", "confidence"), [(Z, 0.95), (1.0, 0.6826894921)])
@pytest.mark.parametrize("counts", TABLES, ids=str)
def test_difference_interval_matches_its_formula(counts: PairedCounts, z: float, confidence: float) -> None:
    a, b, c, d = astuple(counts)
    n = a + b + c + d
    p, q = (a + b) / n, (a + c) / n
    (l1, u1), (l2, u2) = wilson_by_hand(a + b, n, z), wilson_by_hand(a + c, n, z)
    product = a * d - b * c
    corrected = product - n / 2 if product > n / 2 else min(product, 0)
    phi = corrected / sqrt((a + b) * (c + d) * (a + c) * (b + d))
    low = p - q - sqrt((p - l1) ** 2 - 2 * phi * (p - l1) * (u2 - q) + (u2 - q) ** 2)
    high = p - q + sqrt((u1 - p) ** 2 - 2 * phi * (u1 - p) * (q - l2) + (q - l2) ** 2)
    assert paired_difference_interval(counts, confidence) == pytest.approx((low, high), abs=1e-6)


@pytest.mark.parametrize("counts", [*TABLES, PairedCounts(50, 0, 0, 0), PairedCounts(0, 9, 0, 0)], ids=str)
def test_exchange_of_the_policies_negates_the_difference(counts: PairedCounts) -> None:
    low, high = paired_difference_interval(counts)
    assert -1.0 <= low <= counts.difference <= high <= 1.0
    assert paired_difference_interval(exchanged(counts)) == pytest.approx((-high, -low))
    wider = paired_difference_interval(counts, confidence=0.99)
    assert wider[0] <= low
    assert high <= wider[1]
    assert wider[1] - wider[0] > high - low


def test_equal_policies_without_failures_may_still_differ_a_little() -> None:
    low, high = paired_difference_interval(PairedCounts(200, 0, 0, 0))
    assert high == pytest.approx(1.0 - wilson_by_hand(200, 200)[0])
    assert low == pytest.approx(-high)


@pytest.mark.parametrize("p", [(0.50, 0.20, 0.10, 0.20), (0.45, 0.08, 0.04, 0.43)])
def test_difference_interval_covers_the_truth_as_often_as_it_says(p: tuple[float, ...]) -> None:
    draws = np.random.default_rng(0).multinomial(60, p, size=1000)
    tables, times = np.unique(draws, axis=0, return_counts=True)
    intervals = [paired_difference_interval(PairedCounts(*map(int, table))) for table in tables]
    covered = [low <= p[1] - p[2] <= high for low, high in intervals]
    assert 0.93 <= np.average(covered, weights=times) <= 0.98


def test_holm_multiplies_the_smallest_most_and_never_reverses_an_order() -> None:
    assert holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    assert holm([0.02]) == [0.02]
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


# ------------------------------------------------------------------ trainings


def test_trainings_are_not_pooled() -> None:
    spread = TrainingSpread((200, 190, 180), 200)
    assert spread.rates == (1.0, 0.95, 0.9)
    assert spread.mean == pytest.approx(0.95)
    assert spread.sd == pytest.approx(0.05)
    assert str(spread) == "3 × 200: 95.0 % (90.0 to 100.0, SD 5.0)"
    assert str(TrainingSpread((200, 120, 40), 200)) == "3 × 200: 60.0 % (20.0 to 100.0, SD 40.0)"


def test_one_training_has_no_spread() -> None:
    assert TrainingSpread((3,), 4).sd == 0.0
    assert str(TrainingSpread((0,), 1)) == "1 × 1: 0.0 % (0.0 to 0.0, SD 0.0)"


@pytest.mark.parametrize(("successes", "trials"), [((), 5), ((6,), 5), ((3, -1), 5), ((0,), 0)])
def test_impossible_trainings_are_refused(successes: tuple[int, ...], trials: int) -> None:
    with pytest.raises(ValueError, match=f"from 0 to {trials} successes"):
        TrainingSpread(successes, trials)


def test_the_same_trainings_are_drawn_for_both_at_once() -> None:
    """Three trainings that succeed on 95, 75 and 55 % lose 3 points each: the difference is as certain as seeds make it."""
    rng = np.random.default_rng(5)
    first = rng.random((3, 400)) < np.array([[0.95], [0.75], [0.55]])
    second = first & (rng.random((3, 400)) > 0.04)
    apart, together = (difference_over_trainings(second, first, same_trainings=same) for same in (False, True))
    assert apart[1] - apart[0] > 0.3
    assert together[1] - together[0] < 0.12
    surer = difference_over_trainings(second, first, confidence=0.5)
    assert surer[1] - surer[0] < (apart[1] - apart[0]) / 2
    assert together[0] <= second.mean() - first.mean() <= together[1]
    assert bootstrap_difference(second, first, same_trainings=True)[1] < 0.0, "no training gains"
    with pytest.raises(ValueError, match=r"the same trainings must be as many, got 3 and 2"):
        bootstrap_difference(second, first[:2], same_trainings=True)


def test_several_trainings_are_no_surer_than_their_seeds() -> None:
    never = np.ones((3, 200), np.bool_)
    assert bootstrap_difference(never, never) == (0.0, 0.0)
    alone = paired_difference_interval(PairedCounts(200, 0, 0, 0))
    assert difference_over_trainings(never, never) == pytest.approx(alone)
    assert difference_over_trainings(never[:1], never[:1]) == pytest.approx(alone)


def test_both_policies_trainings_make_an_interval_wider() -> None:
    spread = np.array([[True] * 200, [i % 2 == 0 for i in range(200)]])
    steady = np.tile(np.arange(200) % 4 > 0, (2, 1))
    for first, second in ((spread, steady), (steady, spread)):
        low, high = bootstrap_difference(first, second)
        assert high - low > 0.3


@pytest.mark.parametrize(("trainings", "low", "high"), [(2, 0.70, 0.88), (3, 0.80, 0.94), (5, 0.86, 0.97)])
def test_a_bootstrap_over_few_trainings_is_too_narrow_and_ours_is_not(trainings: int, low: float, high: float) -> None:
    """Equal methods of 75 %, trainings that differ by 10 points (SD), 200 seeds."""
    rng, alone, covered = np.random.default_rng(trainings), [], []
    for _ in range(300):
        rates = np.clip(rng.normal(0.75, 0.1, (2, trainings, 1)), 0.0, 1.0)
        first, second = rng.random((2, trainings, 200)) < rates
        for interval, found in ((bootstrap_difference, alone), (difference_over_trainings, covered)):
            bounds = interval(first, second, resamples=300)
            found.append(bounds[0] <= 0.0 <= bounds[1])
    assert low <= np.mean(alone) <= high
    assert np.mean(covered) >= 0.92


def test_student_takes_trainings_for_what_differs() -> None:
    """Rates of 40, 60 and 80 % against 70, 80 and 90 %: pooled variance (0.04 + 0.01) / 2, four degrees of freedom."""
    first, second = (
        np.arange(100) < np.array([[share] for share in shares]) for shares in ((40, 60, 80), (70, 80, 90))
    )
    half = 2.776445105 * sqrt(0.025 * 2 / 3)
    assert student_difference(first, second) == pytest.approx((-0.2 - half, -0.2 + half))
    paired = 4.302652730 * sqrt(0.01 / 3)
    assert student_difference(first, second, same_trainings=True) == pytest.approx((-0.2 - paired, -0.2 + paired))
    low, high = student_difference(first, second, confidence=0.99)
    assert low < -0.2 - half
    assert high == pytest.approx(-0.4 - low)
    apart = np.zeros((2, 4), np.bool_), np.ones((2, 4), np.bool_)
    assert student_difference(*apart) == (-1.0, -1.0)
    wide = student_difference(apart[0], np.arange(4) < np.array([[4], [1]]))
    assert wide == (-1.0, pytest.approx(-0.625 + 4.302652730 * 0.375))
