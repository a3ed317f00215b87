"""``scilab-rl study [NAME]``: what a hyperparameter study has found, also while it runs."""

from __future__ import annotations

import importlib.util
import logging
import os
import re
import sys
from pathlib import Path
from typing import Any

from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.tables import print_json, print_rows
from scilab_rl.errors import ConfigError, MissingDependencyError
from scilab_rl.files import write_text
from scilab_rl.hyperopt.folders import REPORT, find_study, study_names
from scilab_rl.workspace import DESK_CONF, SHIPPED_CONF

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser("study", "Show what a hyperparameter study has found.")
    parser.add_argument("name", nargs="?", help="name of the study; without one, list them")
    parser.add_argument("--base-logdir", type=Path, default=Path("data"), help="default: data")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--write-tuned",
        action="store_true",
        help="keep the winner in conf/tuned_values, where later runs find it by themselves",
    )
    parser.add_argument(
        "--dashboard", action="store_true", help="browse it with optuna-dashboard, on this machine"
    )
    parser.add_argument("--port", type=int, default=8080, help="of the dashboard; default: 8080")
    options = parser.parse_args(arguments)
    if options.name is None:
        _list(options.base_logdir)
        return 0
    directory = find_study(options.name, options.base_logdir)
    if options.dashboard:
        return _open_dashboard(directory, options.port)
    _show(directory, as_json=options.json)
    if options.write_tuned:
        _keep_winner(directory)
    return 0


def _list(base: Path) -> None:
    names = study_names(base)
    if not names:
        _log.info("No studies in '%s'. A --multirun with a search space makes one.", base)
    else:
        rows = [{"study": name, "path": str(find_study(name, base))} for name in names]
        print_rows(("study", "path"), rows)


def _show(directory: Path, *, as_json: bool) -> None:
    from scilab_rl.hyperopt.ledger import open_ledger
    from scilab_rl.hyperopt.report import write_report

    report = write_report(open_ledger(directory))
    summary = report.summary
    names = list(summary.definition["space"])
    rows: list[dict[str, Any]] = [
        {
            "setting": f"#{row.number}",
            **{name: row.setting.get(name) for name in names},
            "runs": row.n_runs,
            "score": row.interval,
            "verdict": row.verdict,
        }
        for row in summary.rows
    ]
    if as_json:
        print_json({"study": summary.name, "facts": dict(summary.facts()), "settings": rows})
        return
    print_rows(("setting", *names, "runs", "score", "verdict"), rows, optional=names[3:])
    if summary.importance:
        weights = [{"parameter": n, "importance": w} for n, w in summary.importance.items()]
        print_rows(("parameter", "importance"), weights)
    report.print_summary()


def _keep_winner(directory: Path) -> None:
    from scilab_rl.hyperopt.ledger import open_ledger
    from scilab_rl.hyperopt.report import tuned_values
    from scilab_rl.hyperopt.summary import summarize

    summary = summarize(open_ledger(directory))
    if summary.winner is None:
        raise ConfigError(f"The study {summary.name} has no winner to keep.")
    family = re.sub(r"-v\d+$", "", summary.definition["env"])
    name = Path("tuned_values") / family / f"{summary.definition['algorithm']}.yaml"
    for path in (SHIPPED_CONF / name, DESK_CONF / name):
        if path.is_file():
            raise ConfigError(
                f"There are tuned values for this pair already, in '{path}'. Compare them, and "
                f"take over by hand what '{directory / 'winner.yaml'}' holds."
            )
    path = DESK_CONF / name
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, tuned_values(summary))
    _log.info("Written to %s: later runs of this pair use it.", path)


def _open_dashboard(directory: Path, port: int) -> int:
    if importlib.util.find_spec("optuna_dashboard") is None:
        raise MissingDependencyError("optuna-dashboard", "hyperopt", "to browse a study")
    from scilab_rl.hyperopt.ledger import stored_url

    command = str(Path(sys.executable).with_name("optuna-dashboard"))
    # What a sampler was told once cannot change: it holds the first repeats only.
    _log.info(
        "%s: http://127.0.0.1:%d (Ctrl-C ends it). It shows the mean of each setting's first "
        "repeats; the winner of all repeats is in %s.",
        directory.name, port, directory / REPORT,
    )  # fmt: skip
    where = ["--host", "127.0.0.1", "--port", str(port)]
    os.execv(command, [command, stored_url(directory), *where])
