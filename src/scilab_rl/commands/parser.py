"""The options of the sub-commands, with errors of one line."""

from __future__ import annotations

import argparse
from typing import NoReturn

from scilab_rl.errors import ConfigError, did_you_mean


class CommandParser(argparse.ArgumentParser):
    """An argument parser whose errors are ours: what was given, what is allowed, exit code 2.

    Args:
        command: The sub-command, for example ``runs``.
        description: What it does, in one line.
    """

    def __init__(self, command: str, description: str) -> None:
        super().__init__(prog=f"scilab-rl {command}", description=description, allow_abbrev=False)

    def parse_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        """Parse the arguments and refuse those that no option takes.

        Raises:
            ConfigError: If an argument is unknown or a value cannot be.
        """
        options, unknown = self.parse_known_args(args, namespace)
        if unknown:
            known = [word for action in self._actions for word in action.option_strings]
            given = unknown[0].partition("=")[0] if unknown[0].startswith("-") else unknown[0]
            suggestion = did_you_mean(given, known) if given.startswith("-") else ""
            self.error(f"unknown argument '{given}'.{suggestion} It takes {', '.join(known)}.")
        return options

    def error(self, message: str) -> NoReturn:
        """Turn a message of argparse into our error."""
        raise ConfigError(f"{self.prog}: {message}")


def positive(text: str) -> int:
    """Return a count of at least 1 that was given as text."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, but it is '{text}'")
    return number
