"""Comparisons of runs in Python."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from scilab_rl.analysis.comparison import Comparison, ComparisonSettings
from scilab_rl.analysis.comparison import compare as compare_groups
from scilab_rl.analysis.groups import Group, RunRecord, find_group, read_record, read_records
from scilab_rl.analysis.report import conclusion, contrast_rows, group_rows, write_reports
from scilab_rl.api.run import Run
from scilab_rl.api.shown import in_frame
from scilab_rl.api.tables import as_table
from scilab_rl.errors import ConfigError
from scilab_rl.run.facts import matches_name

if TYPE_CHECKING:  # heavy
    import pandas

Runs: TypeAlias = str | Run | Sequence[Run] | Group


@dataclass(frozen=True, repr=False)
class ComparisonSummary:
    """Which group of runs learns better, and how sure that is; a notebook shows it as a page.

    Attributes:
        comparison: All estimates.
    """

    comparison: Comparison

    @property
    def conclusions(self) -> list[str]:
        """One sentence for each group but the first."""
        return [conclusion(self.comparison, contrast) for contrast in self.comparison.contrasts]

    @property
    def groups(self) -> pandas.DataFrame:
        """The estimates of each group, with their 95 % intervals.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        return as_table(group_rows(self.comparison))

    @property
    def contrasts(self) -> pandas.DataFrame:
        """The difference of each group from the first one.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        return as_table(contrast_rows(self.comparison))

    def save(self, folder: str | Path, *, parquet: bool = False) -> list[Path]:
        """Write page, pictures and tables, and return their paths, that of the page first.

        Args:
            folder: Created if missing.
            parquet: Whether the table of runs is also written as Parquet.

        Raises:
            MissingDependencyError: If Parquet is requested and pyarrow is not installed.
        """
        return write_reports(self.comparison, Path(folder), parquet=parquet)

    def __repr__(self) -> str:
        return f"<ComparisonSummary of {', '.join(g.label for g in self.comparison.groups)}>"

    def __str__(self) -> str:
        return "\n".join([*self.conclusions, *(f"Note: {n}" for n in self.comparison.notes)])

    def _repr_html_(self) -> str:
        with tempfile.TemporaryDirectory() as folder:
            page = self.save(folder)[0].read_text(encoding="utf-8")
        return in_frame(page, height=900)


def compare(
    *groups: Runs | Mapping[str, Runs],
    env: str | None = None,
    metric: str | None = None,
    score: str = "final",
    threshold: float = 0.9,
    base_logdir: str | Path = "data",
) -> ComparisonSummary:
    """Compare groups of runs with the first of them; the same as ``scilab-rl compare``.

    Args:
        groups: Each a word as the command line takes it (an algorithm, a group, a tag, a study, a
            run, or a pattern), a run, or runs. One mapping gives them labels:
            ``{"sparse": runs, "dense": others}``.
        env: Only the runs in this environment, with or without version; ``*`` stands for any text.
        metric: None means success where all runs have it, else the mean reward.
        score: ``final``, ``auc`` or ``steps_to_threshold``.
        threshold: For the steps.
        base_logdir: The folder of all runs.

    Raises:
        ConfigError: If there are fewer than two groups, or nothing to compare.
    """
    named = [pair for group in groups for pair in _named(group)]
    if len(named) < 2:
        raise ConfigError("compare requires two groups, for example sac and cleansac.")
    base = Path(base_logdir)
    records = functools.cache(lambda: read_records(base))
    found = [
        find_group(f"{label}={runs}" if label else runs, records, base)
        if isinstance(runs, str)
        else _group(label, runs)
        for label, runs in named
    ]
    if env is not None:
        found = [_only(group, env) for group in found]
    return ComparisonSummary(compare_groups(found, ComparisonSettings(metric, score, threshold)))


def _named(group: Runs | Mapping[str, Runs]) -> list[tuple[str, Runs]]:
    return list(group.items()) if isinstance(group, Mapping) else [("", group)]


def _only(group: Group, env: str) -> Group:
    runs = tuple(run for run in group.runs if matches_name(run.env, env))
    if not runs:
        raise ConfigError(f"{group.label} has no run in {env}.")
    return replace(group, runs=runs)


def _group(label: str, runs: Run | Sequence[Run] | Group) -> Group:
    if isinstance(runs, Group):
        return replace(runs, label=label or runs.label)
    listed = [runs] if isinstance(runs, Run) else list(runs)
    records = tuple(_record(run) for run in listed)
    names = label or " and ".join(dict.fromkeys(record.algorithm for record in records))
    return Group(names, f"{len(records)} runs", records)


def _record(run: Run) -> RunRecord:
    record = read_record(run.directory)
    if record is None:
        raise ConfigError(f"The files of the run '{run.path}' cannot be read.")
    return record
