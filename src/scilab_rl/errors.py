"""Errors for people: what was given, what is allowed, what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class ScilabRLError(Exception):
    """Something the user can understand and repair; shown as one line.

    Attributes:
        exit_code: What the command line returns: 1 for a run that failed, 2 for wrong input, 3 for
            several runs of which some failed.
    """

    exit_code = 1


class ConfigError(ScilabRLError):
    """The configuration or the command line cannot work; nothing has been started."""

    exit_code = 2


class MissingDependencyError(ConfigError):
    """An optional package is needed and not installed.

    Args:
        package: The package that failed to import.
        extra: The extra of Scilab-RL that installs it.
        purpose: What it is needed for, as in "to track runs with MLflow".
        pip_options: Options of pip, with a space at the end.
    """

    def __init__(self, package: str, extra: str, purpose: str, pip_options: str = "") -> None:
        super().__init__(
            f"{package} is needed {purpose} and is not installed. "
            f'Install it with: pip install {pip_options}"scilab-rl[{extra}]"'
        )


class AlgorithmError(ScilabRLError):
    """An algorithm failed while it was learning."""


class NumericalError(AlgorithmError):
    """A NaN or an infinity appeared where a number has to be."""


class EnvironmentFailure(ScilabRLError):
    """An environment failed or broke its contract."""


class SomeRunsFailedError(ScilabRLError):
    """A multirun or a study has ended, and some of its runs failed."""

    exit_code = 3


class CheckpointError(ScilabRLError):
    """A saved policy or checkpoint is damaged or does not fit."""


class TrackingError(ScilabRLError):
    """A tracker could not be opened. Training never depends on one."""


class RenderingError(ScilabRLError):
    """No frame can be drawn on this machine."""


def did_you_mean(given: str, allowed: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" for the nearest allowed word, or an empty string.

    Case and the characters ``-_`` do not count, so that ``fetch_reach-v4`` finds ``FetchReach-v4``.

    >>> did_you_mean("algoritm", ["algorithm", "env"])
    " Did you mean 'algorithm'?"
    >>> did_you_mean("zzz", ["algorithm", "env"])
    ''
    """
    nearest = nearest_word(given, allowed)
    return f" Did you mean '{nearest}'?" if nearest is not None else ""


def nearest_word(given: str, allowed: Iterable[str]) -> str | None:
    """Return the allowed word that is most like the given one, or None if none is near."""
    plain = {word: word.lower().replace("-", "").replace("_", "") for word in allowed}
    target = given.lower().replace("-", "").replace("_", "")

    def likeness(word: str) -> float:
        return difflib.SequenceMatcher(None, target, plain[word]).ratio()

    best = max(plain, key=likeness, default=None)
    return best if best is not None and likeness(best) >= 0.6 else None


def first_line(error: BaseException) -> str:
    r"""Return the first line of an error's message, or its type when it has none.

    >>> first_line(ValueError("No space left.\nDetails follow.")), first_line(KeyboardInterrupt())
    ('No space left.', 'KeyboardInterrupt')
    """
    return str(error).strip().partition("\n")[0] or type(error).__name__


def listing(words: Iterable[str], limit: int = 12) -> str:
    """Return the words in order, separated by commas, and how many more there are.

    >>> listing(["b", "a", "c"], limit=2)
    'a, b, ... (1 more)'
    """
    ordered = sorted(words)
    shown = ", ".join(ordered[:limit])
    hidden = len(ordered) - limit
    return f"{shown}, ... ({hidden} more)" if hidden > 0 else shown
