"""Patience with a database server that is away for a while, as during a restart."""

from __future__ import annotations

import logging
import sqlite3
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from scilab_rl.errors import ScilabRLError, first_line

_log = logging.getLogger(__name__)
LONGEST_SECONDS = 600.0
RETRY_SECONDS = 1.0
Result = TypeVar("Result")


class DatabaseAwayError(ScilabRLError):
    """A database server does not answer."""


def outlast(
    work: Callable[[], Result], study: str, patience: float, while_waiting: Callable[[float], None]
) -> Result:
    """Do something and return its result; while the server is away, wait, and do it again.

    Args:
        work: What to do; it must be possible to repeat it after it has stopped anywhere.
        study: Name of the study, for messages.
        patience: Seconds to wait at most.
        while_waiting: Called before each new attempt, with the seconds that the last one took.

    Raises:
        DatabaseAwayError: If the server stays away for longer.
    """
    since = None
    while True:
        attempted = time.monotonic()
        try:
            result = work()
        except Exception as error:
            if not is_outage(error):
                raise
            now, reason = time.monotonic(), database_message(error)
            if now - (since or now) >= patience:
                raise DatabaseAwayError(
                    f"The database of the study {study} does not answer ({reason}). When it is "
                    "back, the same command continues the study."
                ) from error
            if since is None:
                _log.warning(
                    "The database of the study %s does not answer (%s): waiting for it, for at "
                    "most %.0f minutes.", study, reason, patience / 60,
                )  # fmt: skip
            since = since or now
            time.sleep(RETRY_SECONDS)
            while_waiting(time.monotonic() - attempted)
        else:
            if since is not None:
                _log.warning("The database is back; the study %s continues.", study)
            return result


def is_outage(error: BaseException) -> bool:
    """Return whether an error means that a server is away, rather than that a request is wrong."""
    import sqlalchemy.exc as sql

    for cause in _causes(error):
        if isinstance(cause, sql.DBAPIError):
            connecting = isinstance(cause, sql.OperationalError) and cause.statement is None
            is_file = isinstance(cause.orig, sqlite3.Error)
            return not is_file and (connecting or cause.connection_invalidated)
    # A connection that broke earlier says only that it did.
    return any(isinstance(cause, sql.PendingRollbackError) for cause in _causes(error))


def database_message(error: BaseException) -> str:
    """Return the first line of the database's own message."""
    *_, origin = _causes(error)
    return first_line(origin)


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = getattr(error, "orig", None) or error.__cause__
