"""Which episodes are kept as recordings."""

from __future__ import annotations


def check_keep(option: str, keep: str) -> None:
    """Raises ValueError unless ``keep`` says which episodes to keep as recordings; ``option`` is what a user typed."""
    if keep not in ("failures", "all", "none") and not keep.isdigit():
        raise ValueError(f"{option} must be failures, all, none or a number, got {keep!r}")


def keeps(keep: str, number: int, success: bool) -> bool:
    """Whether to keep the episode of this number, counted from 0."""
    if keep.isdigit():
        return number < int(keep)
    return keep == "all" or (keep == "failures" and not success)
