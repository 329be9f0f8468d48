"""What the commands share: parsing, one-line errors, and the check of a repository's name."""

from __future__ import annotations

import errno
import logging
import os
import sys
from collections.abc import Callable
from dataclasses import fields
from itertools import pairwise
from typing import Any

import draccus

from hdril.errors import UserError

EXPECTED = (UserError, ValueError, OSError)
"""Failures that the user can mend. Anything else is a bug, and keeps its traceback."""
_REMEDIES = {
    ("ENOSPC", "EDQUOT", "EFBIG"): "make room there, then give the same command again",
    ("EROFS", "EACCES", "EPERM"): "change that, or choose another place",
    ("EEXIST", "ENOTDIR", "EISDIR", "ENOTEMPTY"): "something is in the way: move it, or choose another place",
}
"""What to do about failures of the system, by their names."""


def check_repo_id(option: str, repo_id: str) -> None:
    """Check the name of a repository on the Hugging Face Hub, without asking the Hub.

    Raises:
        ValueError: it is not ``user/name`` in the Hub's own terms.
    """
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import validate_repo_id

    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise ValueError(f"{option} must look like user/name, got {repo_id!r}: {error}") from None
    if "/" not in repo_id:
        raise ValueError(f"{option} must look like user/name, got {repo_id!r}")


def _with_underscores(argument: str) -> str:
    """``--num-episodes=5`` as ``--num_episodes=5``: LeRobot's own commands use both."""
    name, equals, value = argument.partition("=")
    return (name[:2] + name[2:].replace("-", "_") + equals + value) if name.startswith("--") else argument


def _switches(arguments: list[str], config_class: type[Any]) -> list[str]:
    """``--web`` as ``--web=true``, for options that are yes or no."""
    names = {f"--{entry.name}" for entry in fields(config_class) if entry.type in (bool, "bool")}
    return [
        f"{argument}=true" if argument in names and after.startswith("--") else argument
        for argument, after in pairwise([*arguments, "--"])
    ]


def _named(arguments: list[str], positional: str) -> list[str]:
    """``FOLDER`` as ``--dataset=FOLDER``, for a command whose first argument needs no name."""
    if positional and arguments and not arguments[0].startswith("-"):
        return [f"--{positional}={arguments[0]}", *arguments[1:]]
    return arguments


def run(program: str, config_class: type[Any], command: Callable[[Any], None], positional: str = "") -> None:
    """Parse the command line and run ``command``; a failure that a user can mend is one line and exit code 2.

    ``positional`` is the option whose value may stand first, without its name.
    ``HDRIL_DEBUG=1`` shows the traceback instead. Any other exception is a bug: it keeps its traceback, and the exit code is 1.
    Ctrl-C exits with 130.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    try:
        arguments = [_with_underscores(argument) for argument in _named(sys.argv[1:], positional)]
        command(draccus.parse(config_class, args=_switches(arguments, config_class)))
    except KeyboardInterrupt:
        print(f"\n{program}: interrupted", file=sys.stderr)
        sys.exit(130)
    except (*EXPECTED, draccus.utils.DraccusException) as error:
        reason = _reason(error)
        if os.environ.get("HDRIL_DEBUG") or not isinstance(reason, (*EXPECTED, draccus.utils.DraccusException)):
            raise
        print(f"{program}: error: {' '.join(_words(reason).split())}", file=sys.stderr)
        sys.exit(2)


def _words(error: BaseException) -> str:
    """What failed, and for a failure of the system which file, why, and what to do."""
    if isinstance(error, OSError) and error.errno is not None:
        for names, remedy in _REMEDIES.items():
            if errno.errorcode.get(error.errno) in names:
                file = error.filename2 or error.filename  # of a file that is moved, where it was to go
                where = f"{file}: " if file else ""
                return f"{where}{os.strerror(error.errno)}; {remedy}"
    return str(error)


def _reason(error: BaseException) -> BaseException:
    """What helps: draccus names the option whose value it cannot read, but wraps what a config class says of its values."""
    if isinstance(error, draccus.utils.DecodingError) or not isinstance(error, draccus.utils.DraccusException):
        return error
    return error.__cause__ or error
