"""Tables as pandas has them, for those who have pandas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from scilab_rl.errors import MissingDependencyError

if TYPE_CHECKING:
    import pandas


def as_table(rows: Sequence[Mapping[str, object]]) -> pandas.DataFrame:
    """Return rows as a table; what a row lacks is missing there.

    Raises:
        MissingDependencyError: If pandas is not installed.
    """
    try:
        import pandas
    except ImportError as error:
        raise MissingDependencyError("pandas", "pandas", "for tables in Python") from error
    return pandas.DataFrame.from_records([dict(row) for row in rows])
