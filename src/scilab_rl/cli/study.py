"""``scilab-rl study [stop] [NAME]``: what a hyperparameter study has found, also while it runs."""

from __future__ import annotations

import argparse
import importlib.util
import logging
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import print_json, print_rows
from scilab_rl.config.workspace import PROJECT_CONF, SHIPPED_CONF
from scilab_rl.errors import ConfigError, MissingDependencyError
from scilab_rl.files import write_text
from scilab_rl.search.folders import REPORT, STUDIES, find_study, study_names

if TYPE_CHECKING:
    from scilab_rl.search.storage import StudyStorage

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "study", "Show the results of a hyperparameter study.", base=True, json=True
    )
    parser.add_argument(
        "words",
        nargs="*",
        metavar="[stop] NAME",
        help="the study, shown or stopped on all machines; without a name, list all studies",
    )
    parser.add_argument(
        "--storage", metavar="URL", help="its database, on a machine that has not its folder"
    )
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
    *actions, name = options.words or [""]
    if actions not in ([], ["stop"]) or options.words == ["stop"]:
        parser.error("give the name of one study, or stop and the name of one study")
    if not name:
        _list(options.base_logdir, options.storage)
        return 0
    storage = _open(name, options)
    if actions:
        return _stop(storage)
    if options.dashboard:
        return _open_dashboard(storage, options.port)
    _show(storage, as_json=options.json)
    if options.write_tuned:
        _keep_winner(storage)
    return 0


def _open(name: str, options: argparse.Namespace) -> StudyStorage:
    from scilab_rl.search.storage import open_study

    if options.storage is None:
        return open_study(find_study(name, options.base_logdir))
    return open_study(options.base_logdir / STUDIES / name, options.storage)


def _stop(storage: StudyStorage) -> int:
    storage.transact(storage.request_stop)
    running = sum(run.state == "running" for run in storage.runs())
    _log.info(
        "%s: no further run starts; %d still train. The study's own command continues it.",
        storage.directory.name, running,
    )  # fmt: skip
    return 0


def _list(base: Path, url: str | None) -> None:
    if url is not None:
        from scilab_rl.search.storage import stored_studies

        print_rows(("study",), [{"study": name} for name in stored_studies(url)])
        return
    names = study_names(base)
    if not names:
        _log.info("No studies in '%s'. A --multirun with a search space makes one.", base)
    else:
        rows = [{"study": name, "path": str(find_study(name, base))} for name in names]
        print_rows(("study", "path"), rows)


def _show(storage: StudyStorage, *, as_json: bool) -> None:
    from scilab_rl.search.report import write_report

    report = write_report(storage)
    summary = report.summary
    names = list(summary.definition["space"])
    rows: list[dict[str, object]] = [
        {
            "configuration": f"#{row.number}",
            **{name: row.configuration.get(name) for name in names},
            "runs": row.n_runs,
            "score": row.interval,
            "verdict": row.verdict,
        }
        for row in summary.rows
    ]
    if as_json:
        print_json({"study": summary.name, "facts": dict(report.facts()), "configurations": rows})
        return
    print_rows(("configuration", *names, "runs", "score", "verdict"), rows, optional=names[3:])
    if summary.importance:
        weights = [{"parameter": n, "importance": w} for n, w in summary.importance.items()]
        print_rows(("parameter", "importance"), weights)
    report.print_summary()


def _keep_winner(storage: StudyStorage) -> None:
    from scilab_rl.search.report import tuned_values
    from scilab_rl.search.summary import summarize

    summary = summarize(storage)
    if summary.winner is None:
        raise ConfigError(f"The study {summary.name} has no winner to keep.")
    family = re.sub(r"-v\d+$", "", summary.definition["env"])
    name = Path("tuned_values") / family / f"{summary.definition['algorithm']}.yaml"
    for path in (SHIPPED_CONF / name, PROJECT_CONF / name):
        if path.is_file():
            raise ConfigError(
                f"There are tuned values for this pair already, in '{path}'. Compare them, and "
                f"take over by hand what '{storage.directory / 'winner.yaml'}' holds."
            )
    path = PROJECT_CONF / name
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, tuned_values(summary))
    _log.info("Written to %s: later runs of this pair use it.", path)


def _open_dashboard(storage: StudyStorage, port: int) -> int:
    if importlib.util.find_spec("optuna_dashboard") is None:
        raise MissingDependencyError("optuna-dashboard", "hyperopt", "to browse a study")
    command = str(Path(sys.executable).with_name("optuna-dashboard"))
    # The values in a sampler cannot change: it contains the first repeats only.
    _log.info(
        "%s: http://127.0.0.1:%d (Ctrl-C ends it). It shows the mean of each configuration's first "
        "repeats; the winner of all repeats is in %s.",
        storage.directory.name, port, storage.directory / REPORT,
    )  # fmt: skip
    where = ["--host", "127.0.0.1", "--port", str(port)]
    os.execv(command, [command, storage.url, *where])
