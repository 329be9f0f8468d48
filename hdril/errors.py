"""Failures that are no bugs."""

from __future__ import annotations


class UserError(Exception):
    """A failure that whoever runs a command can mend. Commands print its message as one line, without a traceback.

    Its subclasses say what failed. Invalid arguments stay ``ValueError``, and files that are missing or in the way ``OSError``.
    """
