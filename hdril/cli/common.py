"""What the commands share: parsing, and one-line errors."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import draccus

EXPECTED = (ValueError, FileExistsError, FileNotFoundError, NotADirectoryError, KeyError, RuntimeError)


def _with_underscores(argument: str) -> str:
    """``--num-episodes=5`` as ``--num_episodes=5``: LeRobot's own commands are of two minds."""
    name, equals, value = argument.partition("=")
    return (name[:2] + name[2:].replace("-", "_") + equals + value) if name.startswith("--") else argument


def _switches(arguments: list[str], config_class: type[Any]) -> list[str]:
    """``--web`` as ``--web=true``, for options that are yes or no."""
    names = {f"--{entry.name}" for entry in fields(config_class) if entry.type in (bool, "bool")}
    following = [*arguments[1:], "--"]
    return [
        f"{argument}=true" if argument in names and after.startswith("--") else argument
        for argument, after in zip(arguments, following, strict=True)
    ]


def run(program: str, config_class: type[Any], command: Callable[[Any], None]) -> None:
    """Parse the command line and run ``command``; a failure that a user can mend is one line and exit code 2.

    ``HDRIL_DEBUG=1`` shows the traceback instead. Ctrl-C exits with 130.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    try:
        arguments = [_with_underscores(argument) for argument in sys.argv[1:]]
        command(draccus.parse(config_class, args=_switches(arguments, config_class)))
    except KeyboardInterrupt:
        print(f"\n{program}: interrupted", file=sys.stderr)
        sys.exit(130)
    except (*EXPECTED, draccus.utils.DraccusException) as error:
        if os.environ.get("HDRIL_DEBUG"):
            raise
        print(f"{program}: error: {_message(error)}", file=sys.stderr)
        sys.exit(2)


def _message(error: BaseException) -> str:
    """What went wrong, on one line. draccus wraps the reason that a config class gives; the reason is what helps."""
    if isinstance(error, draccus.utils.DraccusException) and isinstance(error.__cause__, EXPECTED):
        return _message(error.__cause__)
    text = error.args[0] if isinstance(error, KeyError) and error.args else error  # KeyError quotes its message
    return " ".join(str(text).split())
