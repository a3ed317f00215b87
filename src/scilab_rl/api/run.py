"""Runs in Python: trained, found again, and read as tables."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from scilab_rl import telemetry
from scilab_rl.api.agent import Agent, load
from scilab_rl.api.isolation import isolated, messages
from scilab_rl.api.shown import Figure, Replay, in_notebook, table_html
from scilab_rl.api.tables import as_table
from scilab_rl.config.compose import compose
from scilab_rl.config.overrides import as_override
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.results import RunResult
from scilab_rl.run.directory import RunDirectory, all_runs, find_run, read_episodes, read_epochs
from scilab_rl.run.facts import matches_name, read_run
from scilab_rl.run.recordings import chosen_recordings, has_recordings
from scilab_rl.run.run import start_run
from scilab_rl.search.folders import study_names

if TYPE_CHECKING:  # heavy
    import pandas

    from scilab_rl.training.callbacks import RunCallback

Where: TypeAlias = str | Callable[[Mapping[str, Any]], object]
_CONSOLE = "tracking.console.enabled"


def train(
    env: str | None = None,
    algorithm: str | None = None,
    *,
    quiet: bool = False,
    callbacks: Sequence[RunCallback] = (),
    **keys: object,
) -> Run:
    """Train an algorithm in an environment; the same as ``scilab-rl env=... algorithm=...``.

    Random generators, signal handlers, loggers and Hydra's state are afterwards as before. Ctrl-C
    ends the training with a checkpoint, and then raises ``KeyboardInterrupt``, as always.

    Args:
        env: Id of the environment; None means the configuration's default.
        algorithm: Name of the algorithm; the same.
        quiet: Whether nothing but warnings is printed.
        callbacks: More callbacks of the training.
        keys: Any other key of the configuration: ``n_epochs=5, seed=1``. Those of the algorithm
            have a dot in their name: ``**{"algorithm.gamma": 0.9}``.

    Returns:
        The run, finished.

    Raises:
        ConfigError: If the configuration cannot work; nothing is left behind.
        ScilabRLError: If the run failed; its directory says how.
    """
    named = {"env": env, "algorithm": algorithm}
    given: dict[str, object] = {key: value for key, value in named.items() if value is not None}
    given |= keys
    if quiet or in_notebook():
        given = {_CONSOLE: False} | given
    overrides = [as_override(key, value) for key, value in given.items()]
    telemetry.switch_off()
    open_project()
    with isolated(), messages(quiet=quiet), warnings.catch_warnings():
        # Of Hydra, about a folder without files of one's own; and of libraries about themselves.
        warnings.simplefilter("ignore")
        if in_notebook() and not quiet:
            from scilab_rl.api.progress import NotebookProgress

            callbacks = [*callbacks, NotebookProgress()]
        result = start_run(compose(overrides), overrides, callbacks)
    if result.signal_number:
        signal.raise_signal(result.signal_number)
    return Run(RunDirectory(Path(result.run_dir)))


def runs(
    env: str | None = None,
    algorithm: str | None = None,
    *,
    where: Where | None = None,
    base_logdir: str | Path = "data",
) -> pandas.DataFrame:
    """Return the recorded runs as a table, the oldest first, with what `Run.facts` says of each.

    Args:
        env: Only this environment, with or without version; ``*`` stands for any text.
        algorithm: Only this algorithm; the same.
        where: Only runs for which this is true: a condition on the columns, as
            ``"success > 0.9 and seed < 4"``, or a function of the facts of a run.
        base_logdir: The folder of all runs.

    Raises:
        ConfigError: If the condition cannot be read.
        MissingDependencyError: If pandas is not installed.
    """
    base = Path(base_logdir)
    studies = study_names(base)
    found = [
        facts
        for facts in (read_run(run, studies) for run in all_runs(base))
        if matches_name(facts["env"], env) and matches_name(facts["algorithm"], algorithm)
        if not callable(where) or where(facts)
    ]
    table = as_table(found)
    return _filtered(table, where) if isinstance(where, str) else table


def _filtered(table: pandas.DataFrame, condition: str) -> pandas.DataFrame:
    try:
        return table.query(condition)
    except Exception as error:
        raise ConfigError(
            f"where='{condition}' cannot be read: {error}. Columns: {', '.join(table.columns)}."
        ) from error


class Run:
    """A recorded run.

    Args:
        run: ``last``, the path, the id or a part of the name of a run; or its directory.
        base_logdir: The folder of all runs.

    Attributes:
        directory: Its directory.

    Raises:
        ConfigError: If there is no such run.
    """

    def __init__(
        self, run: str | Path | RunDirectory = "last", base_logdir: str | Path = "data"
    ) -> None:
        self.directory: RunDirectory = (
            run if isinstance(run, RunDirectory) else find_run(str(run), Path(base_logdir))
        )

    def __repr__(self) -> str:
        facts = self.facts
        score = "" if facts["success"] is None else f" with success {facts['success']:.2f}"
        what = f"{facts['algorithm']} in {facts['env']}"
        return f"<Run {facts['run']}: {what}, {facts['status']}{score}>"

    def _repr_html_(self) -> str:
        return table_html(
            {key: value for key, value in self.facts.items() if value not in (None, "", [])}
        )

    @property
    def path(self) -> Path:
        """The folder with everything that the run has left behind."""
        return self.directory.path

    @property
    def facts(self) -> Mapping[str, Any]:
        """What lists say of the run, see `scilab_rl.run.facts.read_run`."""
        return read_run(self.directory)

    @property
    def config(self) -> Mapping[str, Any]:
        """Its configuration, as YAML has it."""
        return self.directory.read_config()

    @property
    def result(self) -> RunResult:
        """How it ended, and the last values of its metrics.

        Raises:
            ConfigError: If that is missing or damaged.
        """
        result = self.directory.read_result()
        if result is None:
            raise ConfigError(f"The result of '{self.directory}' is missing or damaged.")
        return result

    @property
    def epochs(self) -> list[dict[str, float]]:
        """The metrics of each epoch, the oldest first; `metrics` is the same as a table."""
        epochs = read_epochs(self.directory)
        return [{name: row[name] for name in row if name != "kind"} for row in epochs]

    @property
    def metrics(self) -> pandas.DataFrame:
        """The metrics, a row per epoch.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        return as_table(self.epochs)

    @property
    def episodes(self) -> pandas.DataFrame:
        """The training episodes, a row each.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        return as_table(read_episodes(self.directory))

    def agent(self, policy: str = "best") -> Agent:
        """Load its trained agent; see `load`."""
        return load(self.path, policy=policy)

    def steps(
        self,
        episodes: int = 20,
        *,
        seed: int | None = None,
        per: Literal["step", "episode"] = "step",
    ) -> pandas.DataFrame:
        """Let its agent act, and return what it saw, did, got and thought: `Agent.steps`."""
        with self.agent("finished") as agent:
            return agent.steps(episodes, seed=seed, per=per)

    def replay(self, episode: str = "last") -> Replay:
        """Return a recorded episode, which a notebook shows; without one, record one now.

        Args:
            episode: Its number, from 1, or its name.

        Raises:
            ConfigError: If there is no such episode.
        """
        if episode == "last" and not has_recordings(self.directory):
            with self.agent() as agent:
                return agent.record()
        return Replay(chosen_recordings(self.directory, episode)[0].with_suffix(".html"))

    def plot(self, *metrics: str) -> Figure:
        """Draw metrics over the steps of the training.

        Args:
            metrics: Their names; none means success, or the mean reward where there is none.

        Raises:
            ConfigError: If the run has no such metric.
        """
        rows = self.epochs
        names = list(dict.fromkeys(name for row in rows for name in row))
        if not metrics:
            metrics = tuple(n for n in ("eval/success_rate", "eval/mean_reward") if n in names)[:1]
        for name in metrics:
            if name not in names:
                raise ConfigError(
                    f"The run has no metric '{name}'.{did_you_mean(name, names)} It has: "
                    f"{listing(names)}."
                )
        return Figure.of_curves(
            {name: [(row["step"], row[name]) for row in rows if name in row] for name in metrics}
        )
