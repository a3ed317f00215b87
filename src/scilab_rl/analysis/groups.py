"""Groups of runs: which runs a word of the command line selects, and their curves."""

from __future__ import annotations

import glob
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.progress import track

from scilab_rl.config.schema import learning_config
from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.results import PRUNED, SOLVED
from scilab_rl.run.annotations import read_annotations
from scilab_rl.run.directory import (
    CONFIG_FILE,
    RunDirectory,
    all_runs,
    find_named_run,
    find_run,
    read_epochs,
)
from scilab_rl.run.facts import all_tags
from scilab_rl.search.folders import STUDIES, study_names
from scilab_rl.tracking.console import is_interactive

_MANY = 50  # runs that are read without showing how many are left
SUCCESS, REWARD_TYPE = "eval/success_rate", "reward_type"
FAILED, UNFINISHED = "failed", ("running", "interrupted")
# In no estimate: what crashed, what has not ended, and what a study has cut off.
INCOMPLETE = (FAILED, *UNFINISHED, PRUNED)


@dataclass(frozen=True)
class RunRecord:
    """The data of one run that a comparison uses.

    Attributes:
        path: Its folder.
        task: Environment and its arguments: only runs of the same task are compared. Where success
            is measured, the type of the reward does not belong to it.
        env: Id of the environment.
        algorithm: Name of the algorithm.
        seed: Its seed.
        status: As in ``result.json``; ``failed`` also when there is none.
        steps: Steps at each evaluation.
        values: Metric name to its values, NaN where it was not measured. Shapes: as ``steps``.
        budget: Its configured number of steps.
        seconds: Wall time.
        config: The part of its configuration that affects learning, see `learning_config`.
        group: The value of its key ``group``.
        tags: Its tags, of its configuration and given later.
    """

    path: Path
    task: str
    env: str
    algorithm: str
    seed: int
    status: str
    steps: tuple[int, ...]
    values: Mapping[str, tuple[float, ...]]
    budget: int
    seconds: float
    config: Mapping[str, str]
    group: str | None = None
    tags: tuple[str, ...] = ()

    @property
    def end(self) -> int:
        """The last step of its curve; a solved run keeps its last value to its budget."""
        if self.status == SOLVED:
            return max(self.budget, self.steps[-1] if self.steps else 0)
        return self.steps[-1] if self.steps else 0


@dataclass(frozen=True)
class Group:
    """Runs that are compared as one.

    Attributes:
        label: Its name in tables.
        meaning: How its runs were selected.
        runs: Its runs.
    """

    label: str
    meaning: str
    runs: tuple[RunRecord, ...] = field(repr=False)


def find_group(word: str, records: Callable[[], list[RunRecord]], base: Path) -> Group:
    """Return the runs that a word selects.

    It is tried as a pattern of run names (with ``*``), a study, the path or id of a run, a group,
    an algorithm, a tag, and a part of a run's name, in this order.

    Args:
        word: What the user typed; ``label=word`` gives it another name.
        records: Returns all runs; called once when needed.
        base: Where runs live.

    Raises:
        ConfigError: If no run matches.
    """
    label, separator, rest = word.partition("=")
    label, word = (label, rest) if separator and rest else (word, word)
    if any(sign in word for sign in "*?["):
        return _by_pattern(label, word, records, base)
    if word in study_names(base):
        return _of_study(label, word, base)
    named = find_named_run(word, base)
    if named is not None:  # without reading all runs
        return _of_run(label, named)
    meanings: tuple[tuple[str, Callable[[RunRecord], bool]], ...] = (
        ("group", lambda run: run.group == word),
        ("algorithm", lambda run: run.algorithm == word),
        ("tag", lambda run: word in run.tags),
    )
    everything = records()
    for meaning, fits in meanings:
        found = tuple(run for run in everything if fits(run))
        if found:
            return Group(label, f"{meaning} {word}", found)
    try:
        run = find_run(word, base)
    except ConfigError as error:
        names = {run.algorithm for run in everything} | {r.group for r in everything if r.group}
        raise ConfigError(
            f"'{word}' is not a study, group, algorithm, tag or run in '{base}'."
            f"{did_you_mean(word, names)} There are: {listing(names) or 'none'}."
        ) from error
    return _of_run(label, run)


def read_records(base: Path) -> list[RunRecord]:
    """Return all runs below a folder whose configuration can be read, the oldest first."""
    runs = list(all_runs(base))
    shown = track(
        runs, "Reading runs", console=Console(stderr=True), transient=True,
        disable=not is_interactive() or len(runs) < _MANY,
    )  # fmt: skip
    return [record for run in shown if (record := read_record(run)) is not None]


def read_record(run: RunDirectory) -> RunRecord | None:
    """Return the data of a run, or None if its configuration is damaged."""
    try:
        config = run.read_config()
        algorithm, env = config["algorithm"]["name"], config["env"]
        budget = config["n_epochs"] * config["eval_after_n_steps"]
    except (ConfigError, TypeError, KeyError):
        return None
    result, rows = run.read_result(), read_epochs(run)
    kwargs = dict(config.get("env_kwargs") or {})
    status = FAILED if result is None else result.status
    if status == "running" and not run.is_in_use():
        status = FAILED  # its process is gone
    names = {name for row in rows for name in row if name.startswith(("eval/", "time/train_s"))}
    if SUCCESS in names:  # which reward was learned from does not change what success is
        kwargs.pop(REWARD_TYPE, None)
    return RunRecord(
        path=run.path,
        task=env if not kwargs else f"{env} {json.dumps(kwargs, sort_keys=True)}",
        env=env,
        algorithm=algorithm,
        seed=config.get("seed", 0),
        status=status,
        steps=tuple(row["step"] for row in rows),
        values={n: tuple(row.get(n, math.nan) for row in rows) for n in sorted(names)},
        budget=budget,
        seconds=result.seconds if result is not None else 0.0,
        config=learning_config(config),
        group=config.get("group"),
        tags=tuple(all_tags(config, read_annotations(run).tags)),
    )


def _of_run(label: str, run: RunDirectory) -> Group:
    record = read_record(run)
    if record is None:
        raise ConfigError(f"The files of the run '{run}' cannot be read.")
    return Group(label, "run", (record,))


def _by_pattern(
    label: str, pattern: str, records: Callable[[], list[RunRecord]], base: Path
) -> Group:
    paths = {Path(path).resolve() for path in glob.glob(pattern)}  # noqa: PTH207 - also absolute
    pattern = pattern.rstrip("/")
    found = tuple(
        run
        for run in records()
        if run.path.resolve() in paths or run.path.match(pattern) or _has_name(run, pattern)
    )
    found = found or tuple(
        record
        for path in sorted(paths)
        if (path / CONFIG_FILE).is_file() and (record := read_record(RunDirectory(path)))
    )
    if not found:
        raise ConfigError(f"No run in '{base}' matches '{pattern}'.")
    return Group(label, f"runs {pattern}", found)


def _has_name(run: RunRecord, pattern: str) -> bool:
    from fnmatch import fnmatchcase

    words = (run.algorithm, run.group or "", *run.tags)
    return any(fnmatchcase(word, pattern) for word in words if word)


def _of_study(label: str, name: str, base: Path) -> Group:
    """Return the runs of a study's winner: those with held-out seeds, if any."""
    from scilab_rl.search.storage import open_study
    from scilab_rl.search.summary import summarize

    summary = summarize(open_study(base / STUDIES / name))
    if summary.winner is None:
        raise ConfigError(f"The study {name} has no winner yet.")
    of_winner = [run for run in summary.runs if run.trial == summary.winner.number and run.run_dir]
    unseen = [run for run in of_winner if run.is_final]
    found = (read_record(RunDirectory(Path(run.run_dir))) for run in unseen or of_winner)
    seeds = "held-out seeds" if unseen else "the seeds of the search: an optimistic estimate"
    return Group(label, f"winner of study {name}, {seeds}", tuple(r for r in found if r))
