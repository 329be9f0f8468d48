"""Packages that come along with the policy, found by their entry points."""

from __future__ import annotations

from importlib.metadata import entry_points

GROUP = "lerobot_policy_hdril.companions"


def load_companions() -> None:
    """Import every module that an installed package names in the group :data:`GROUP`.

    Raises:
        ImportError: one of them cannot be imported.
    """
    for companion in entry_points(group=GROUP):
        try:
            companion.load()
        except Exception as error:
            owner = companion.dist.name if companion.dist else "an unknown package"
            raise ImportError(
                f"{companion.value}, which {owner} adds to lerobot_policy_hdril, fails: {error}"
            ) from error
