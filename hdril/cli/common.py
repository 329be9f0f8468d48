"""What the commands share: parsing, and one-line errors."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from typing import Any

import draccus

EXPECTED = (ValueError, FileExistsError, FileNotFoundError, NotADirectoryError, KeyError, RuntimeError)


def _with_underscores(argument: str) -> str:
    """``--num-episodes=5`` as ``--num_episodes=5``: LeRobot's own commands are of two minds."""
    name, equals, value = argument.partition("=")
    return (name[:2] + name[2:].replace("-", "_") + equals + value) if name.startswith("--") else argument


def run(program: str, config_class: type[Any], command: Callable[[Any], None]) -> None:
    """Parse the command line and run ``command``; a failure that a user can mend is one line and exit code 2.

    ``HDRIL_DEBUG=1`` shows the traceback instead. Ctrl-C exits with 130.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    try:
        command(draccus.parse(config_class, args=[_with_underscores(argument) for argument in sys.argv[1:]]))
    except KeyboardInterrupt:
        print(f"\n{program}: interrupted", file=sys.stderr)
        sys.exit(130)
    except (*EXPECTED, draccus.utils.DraccusException) as error:
        if os.environ.get("HDRIL_DEBUG"):
            raise
        # KeyError quotes its message; the first line says it all.
        message = str(error.args[0] if isinstance(error, KeyError) and error.args else error).strip()
        print(f"{program}: error: {' '.join(message.split())}", file=sys.stderr)
        sys.exit(2)
