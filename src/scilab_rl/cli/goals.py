"""``scilab-rl goals RUN``: where in the space of its goals does an agent fail?"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.tables import write
from scilab_rl.config.workspace import open_project
from scilab_rl.run.directory import RunDirectory, find_policy, find_run

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_project()
    from scilab_rl.analysis.goal_report import examine
    from scilab_rl.analysis.goals import GoalSettings

    run = find_run(options.run, options.base_logdir)
    policy = find_policy(run, options.run, options.policy, "best", "finished")
    report = examine(
        run,
        policy,
        GoalSettings(options.cells, options.episodes, options.axes, options.seed),
        checkpoints=_checkpoints(run, options.checkpoint),
        n_recorded=options.record,
        progress=_tell,
    )
    study = report.study
    write(f"success over the goal space: {study.overall}, {options.episodes} episodes per goal")
    write(f"with the goals that are asked for: {study.own}")
    if study.calibration is not None:
        write(f"AUC of the value as a predictor of success: {study.calibration.auc}")
    for finding in study.findings:
        write(f"* {finding}")
    _log.info("%s", report.page)
    return 0


def _tell(done: int, n: int) -> None:
    if done % max(1, n // 5) == 0 and n >= 100:
        _log.info("%d of %d episodes", done, n)


def _checkpoints(run: RunDirectory, names: list[str]) -> list[Path]:
    if names == ["all"]:
        return sorted(run.path.glob("rl_model_*"))
    return [find_policy(run, name) for name in names]


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "goals",
        "Map where in the space of its goals an agent succeeds, what it expects, and what it was "
        "asked for.",
        run=True,
        base=True,
    )
    add = parser.add_argument
    add("--episodes", type=positive, default=4, help="of each goal (default 4)")
    add("--cells", type=_numbers, metavar="N,M", help="goals on each axis (default 15,15)")
    add("--axes", type=_numbers, metavar="I,J", help="dimensions of the goal (default: the free)")
    add("--policy", default="best", help="best (the default), finished or a path")
    add(
        "--checkpoint",
        type=lambda text: text.split(","),
        default=[],
        help="policies whose values are compared: all, or names",
    )
    add("--record", type=int, default=3, metavar="N", help="record N failed episodes (default 3)")
    add("--seed", type=positive, default=1, help="of all chance (default 1)")
    return parser.parse_args(arguments)


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be whole numbers such as 15,15, but it is '{text}'"
        ) from None
