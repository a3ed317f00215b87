"""The files that a study leaves: tables, plots, one page, and the winner as tuned values."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from scilab_rl.files import write_json, write_text
from scilab_rl.run.directory import RunDirectory
from scilab_rl.run.provenance import fingerprint_differences
from scilab_rl.search.folders import REPORT, TABLE, TUNED_FILE, WINNER_FILE
from scilab_rl.search.storage import StudyStorage
from scilab_rl.search.summary import Summary, summarize
from scilab_rl.search.values import override_text
from scilab_rl.tracking.console import print_table

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Report:
    """A study's summary and where its files are.

    Attributes:
        summary: What the study has found.
        directory: The folder of the study.
    """

    summary: Summary
    directory: Path

    def print_summary(self) -> None:
        """Print the result on standard output."""
        print_table(self.facts())

    def facts(self) -> list[tuple[str, str]]:
        """Return what the study has found and where its files are, name and value."""
        facts = [*self.summary.facts(), ("report", str(self.directory / REPORT))]
        files = self.winner_files()
        return [*facts, ("a run of the best configuration", files)] if files else facts

    def winner_files(self) -> str:
        """Return where the winner's best run is, or how to fetch it; empty without a winner."""
        winner, sign = self.summary.winner, 1 if self.summary.maximize else -1
        runs = [
            run
            for run in self.summary.runs
            if winner is not None and run.trial == winner.number and run.scores and run.run_dir
        ]
        if not runs:
            return ""
        best = max(runs, key=lambda run: (run.is_final, sign * run.scores[0]))
        if Path(best.run_dir).is_dir():
            return best.run_dir
        return f"on another machine: scp -r {best.place} {Path(best.run_dir).parent}/"


def write_report(storage: StudyStorage) -> Report:
    """Write the report of a study, finished or not."""
    from scilab_rl.search import page, plots

    summary = summarize(storage)
    directory = storage.directory
    # Runs on other machines, or after an update, may have seen another environment.
    runs = [RunDirectory(Path(run.run_dir)) for run in summary.runs if run.run_dir]
    for line in fingerprint_differences(runs):
        _log.warning(line)
    write_text(directory / TABLE, summary.table())
    if summary.winner is not None:
        write_text(directory / TUNED_FILE, tuned_values(summary))
        write_json(directory / WINNER_FILE, {"overrides": winner_overrides(summary)})
    figures = plots.draw_all(summary, directory / "plots")
    write_text(directory / REPORT, page.render(summary, figures, directory))
    return Report(summary, directory)


def tuned_values(summary: Summary) -> str:
    """Return the winner as a file of the group ``tuned_values``."""
    assert summary.winner is not None
    values: dict[str, Any] = {}
    for name, value in typed_configuration(summary).items():
        _put(values, name.split("."), value)
    facts = "".join(f"# {name}: {text}\n" for name, text in summary.facts()[-4:-1])
    return (
        f"# @package _global_\n# Found by the study {summary.name}.\n{facts}"
        f"{yaml.safe_dump(values, sort_keys=False)}"
    )


def winner_overrides(summary: Summary) -> list[str]:
    """Return the overrides that train with the winner."""
    keys = {name: entry["key"] for name, entry in summary.definition["space"].items()}
    values = typed_configuration(summary).items()
    return [
        *summary.definition["overrides"],
        *(f"{keys[name]}={override_text(value)}" for name, value in values),
    ]


def typed_configuration(summary: Summary) -> Mapping[str, object]:
    """Return the winner's values as an algorithm gets them, with lists as lists."""
    assert summary.winner is not None
    configuration = {}
    for name, value in summary.winner.configuration.items():
        described = summary.definition["space"].get(name, {})
        if "values" in described and value in described["choices"]:
            value = described["values"][described["choices"].index(value)]
        configuration[name] = value
    return configuration


def _put(tree: dict[str, Any], path: list[str], value: object) -> None:
    for part in path[:-1]:
        tree = tree.setdefault(part, {})
    tree[path[-1]] = value
