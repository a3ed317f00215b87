"""The files that a study leaves: tables, plots, one page, and the winner as tuned values."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from scilab_rl.files import write_json, write_text
from scilab_rl.hyperopt.folders import REPORT, TABLE, TUNED_FILE, WINNER_FILE
from scilab_rl.hyperopt.ledger import Ledger
from scilab_rl.hyperopt.space import override_text
from scilab_rl.hyperopt.summary import Summary, summarize
from scilab_rl.provenance import fingerprint_differences
from scilab_rl.results import RunDirectory
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
        facts = [*self.summary.facts(), ("report", str(self.directory / REPORT))]
        print_table(facts)


def write_report(ledger: Ledger) -> Report:
    """Write the report of a study, finished or not."""
    from scilab_rl.hyperopt import page, plots

    summary = summarize(ledger)
    directory = ledger.directory
    # Runs on other machines, or after an update, may have seen another environment.
    runs = [RunDirectory(Path(run.run_dir)) for run in summary.runs if run.run_dir]
    for line in fingerprint_differences(runs):
        _log.warning(line)
    write_text(directory / TABLE, summary.table())
    if summary.winner is not None:
        write_text(directory / TUNED_FILE, tuned_values(summary))
        write_json(directory / WINNER_FILE, {"overrides": winner_overrides(summary)})
    figures = plots.draw_all(summary, directory / "plots")
    write_text(directory / REPORT, page.render(summary, figures))
    return Report(summary, directory)


def tuned_values(summary: Summary) -> str:
    """Return the winner as a file of the group ``tuned_values``."""
    assert summary.winner is not None
    values: dict[str, Any] = {}
    for name, value in typed_setting(summary).items():
        _put(values, name.split("."), value)
    facts = "".join(f"# {name}: {text}\n" for name, text in summary.facts()[-4:-1])
    return (
        f"# @package _global_\n# Found by the study {summary.name}.\n{facts}"
        f"{yaml.safe_dump(values, sort_keys=False)}"
    )


def winner_overrides(summary: Summary) -> list[str]:
    """Return the overrides that train with the winner."""
    keys = {name: entry["key"] for name, entry in summary.definition["space"].items()}
    values = typed_setting(summary).items()
    return [
        *summary.definition["overrides"],
        *(f"{keys[name]}={override_text(value)}" for name, value in values),
    ]


def typed_setting(summary: Summary) -> Mapping[str, Any]:
    """Return the winner's values, with lists as lists."""
    assert summary.winner is not None
    setting = {}
    for name, value in summary.winner.setting.items():
        if isinstance(value, str) and re.match(r"[\[{]", value):
            value = yaml.safe_load(value)
        setting[name] = value
    return setting


def _put(tree: dict[str, Any], path: list[str], value: Any) -> None:
    for part in path[:-1]:
        tree = tree.setdefault(part, {})
    tree[path[-1]] = value
