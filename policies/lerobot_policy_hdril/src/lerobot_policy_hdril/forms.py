"""Forms of primitives: one that begins with a hand closed that is open in others is another movement of the same name.

Where a hand has lost what both carried, it is brought back while the other holds on: `retract` then keeps one hand closed, and
opens both in most demonstrations. Linear maps from what is seen cannot do the one here and the other there. So each form has maps
of its own, and the planner says which one begins. To everybody else they are one primitive.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FEWEST = 5
"""A form that fewer executions of a dataset show is taken for the most frequent one."""

type Form = tuple[int, ...]
"""A primitive's label, and for each number that is halved 1 where it is in the upper half as the primitive begins, else 0."""


def halves(first: NDArray[np.float32], action: NDArray[np.float32]) -> NDArray[np.int64]:
    """Which numbers of the first actions of executions (N, G) are in the upper half of what the actions (T, G) have."""
    return (first > (action.min(0) + action.max(0)) / 2.0).astype(np.int64)


def find_forms(label: NDArray[np.int64], half: NDArray[np.int64], primitives: int) -> list[Form]:
    """The forms of executions of primitives (N,), by which their numbers (N, G) begin in the upper half: by primitive, the most
    frequent form first."""
    forms: list[Form] = []
    for k in range(primitives):
        kinds, counts = np.unique(half[label == k], axis=0, return_counts=True)
        order = np.argsort(-counts, kind="stable")
        forms += [(k, *kinds[i].tolist()) for n, i in enumerate(order) if n == 0 or counts[i] >= FEWEST]
    return forms


def assign(label: NDArray[np.int64], half: NDArray[np.int64], forms: Sequence[Form]) -> NDArray[np.int64]:
    """The form (N,) of each execution; the first of its primitive for one that no form is like."""
    number = {form: i for i, form in reversed(list(enumerate(forms)))}
    first = {form[0]: i for i, form in reversed(list(enumerate(forms)))}
    return np.array(
        [number.get((k, *rest), first[k]) for k, rest in zip(label.tolist(), half.tolist(), strict=True)], np.int64
    )
