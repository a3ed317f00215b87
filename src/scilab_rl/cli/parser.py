"""The arguments of the sub-commands, with errors of one line."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

from scilab_rl.errors import ConfigError, did_you_mean


class CommandParser(argparse.ArgumentParser):
    """An argument parser with the arguments that commands share, and with our errors.

    Args:
        command: The sub-command, for example ``runs``.
        description: Its purpose, in one line.
        run: Whether it takes a run, as its first argument.
        base: Whether it takes ``--base-logdir``.
        json: Whether it takes ``--json``.
    """

    def __init__(
        self,
        command: str,
        description: str,
        *,
        run: bool = False,
        base: bool = False,
        json: bool = False,
    ) -> None:
        super().__init__(prog=f"scilab-rl {command}", description=description, allow_abbrev=False)
        if run:
            self.add_argument(
                "run", help="'last', a run's id or path, a part of its name, or agent:NAME"
            )
        if base:
            self.add_argument(
                "--base-logdir",
                type=Path,
                default=Path("data"),
                metavar="DIR",
                help="folder of all runs; default: data",
            )
        if json:
            self.add_argument("--json", action="store_true", help="print JSON")

    def parse_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        """Parse the arguments and reject unknown ones.

        Raises:
            ConfigError: If an argument is unknown or a value is invalid.
        """
        options, unknown = self.parse_known_args(args, namespace)
        if unknown:
            known = [word for action in self._actions for word in action.option_strings]
            given = unknown[0].partition("=")[0] if unknown[0].startswith("-") else unknown[0]
            suggestion = did_you_mean(given, known) if given.startswith("-") else ""
            self.error(f"unknown argument '{given}'.{suggestion} Options: {', '.join(known)}.")
        return options

    def error(self, message: str) -> NoReturn:
        """Turn a message of argparse into our error."""
        raise ConfigError(f"{self.prog}: {message}")


def positive(text: str) -> int:
    """Convert text to a whole number of at least 1."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, but it is '{text}'")
    return number
