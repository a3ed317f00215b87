"""The course of a study: give each free worker the next run, note what comes back, decide again."""

from __future__ import annotations

import contextlib
import math
import re
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from optuna.trial import TrialState

from scilab_rl.config.schema import RunConfig
from scilab_rl.parallel.jobs import JobPool
from scilab_rl.parallel.pool import Pool
from scilab_rl.parallel.worker import Message, Task
from scilab_rl.search import race, scores
from scilab_rl.search.outages import DatabaseAwayError
from scilab_rl.search.pruning import Pruning
from scilab_rl.search.runs import COMPLETE, FAILED, FINAL_REPEAT, LOST, PRUNED, RUNNING, Run
from scilab_rl.search.settings import StudySettings
from scilab_rl.search.source import ConfigurationSource
from scilab_rl.search.space import SearchSpace, Setting
from scilab_rl.search.storage import StudyStorage
from scilab_rl.seeding import derive_seed

_POLL_SECONDS = 0.5
_LOOK_SECONDS = 1.0  # how often the storage is read while all workers are busy


@dataclass(frozen=True)
class RunPlan:
    """The part of the configuration that all runs of a study share.

    Attributes:
        overrides: The fixed part of their configuration, as typed on a command line.
        cfg: Their configuration, without the searched values.
        seed: Seed of the study; equal repeats of all configurations share the seed derived from it.
        baseline: Their configuration if nothing were searched, where the space holds it.
    """

    overrides: tuple[str, ...]
    cfg: RunConfig
    seed: int
    baseline: Setting | None = None


@dataclass
class StopReasons:
    """Why no further run is started.

    Attributes:
        reason: Empty as long as the study continues.
        signal_number: The signal that asked for it, or 0.
        at_once: Whether to stop without waiting for the running trials.
        deadline: Monotonic time, in seconds, at which it is too late for another run.
    """

    reason: str = ""
    signal_number: int = 0
    at_once: bool = False
    deadline: float = math.inf


class Study:
    """Runs a study to its end, or until it is stopped.

    Args:
        storage: Its memory, shared with other processes.
        pool: What trains the runs: workers of this process, or jobs of a scheduler.
        space: The search space.
        settings: The settings of the study.
        plan: What all runs have in common.
        observer: Told about all runs whenever something has happened.
    """

    def __init__(
        self,
        storage: StudyStorage,
        pool: Pool | JobPool,
        space: SearchSpace,
        settings: StudySettings,
        plan: RunPlan,
        observer: Callable[[Sequence[Run]], None] | None = None,
    ) -> None:
        self.storage = storage
        self.pool = pool
        self.space = space
        self.settings = settings
        self.plan = plan
        self.observer = observer
        self.stop = StopReasons()
        self.source = ConfigurationSource(
            storage, space, settings.sampler, plan.seed, settings.rules, plan.baseline
        )
        self.pruning = Pruning(
            settings.pruner if settings.rules.racing else "none",
            settings.pruner_warmup_epochs,
            plan.cfg.n_epochs,
            maximize=settings.rules.maximize,
        )
        self._training: set[int] = set()  # numbers of the runs in our pool
        self._away_seconds = 0.0  # while the database was away, the runs waited for their answers
        self._finished = False
        self._next_look = 0.0
        storage.while_waiting = self._while_database_is_away

    @property
    def runs(self) -> list[Run]:
        """All runs, as last read or written."""
        return self.storage.history.runs

    def work(self) -> None:
        """Train until the study is over; the storage then holds everything."""
        if self.settings.max_duration_minutes is not None:
            self.stop.deadline = time.monotonic() + 60 * self.settings.max_duration_minutes
        self.storage.transact(self.storage.begin)
        try:
            while self._assign() and not self.stop.at_once:
                for number, message in self.pool.messages(_POLL_SECONDS):
                    self._handle_message(number, message)
                self._end_late_runs()
                if self.observer is not None:
                    self.observer(self.runs)
        finally:
            self.pool.kill_all()
            with contextlib.suppress(DatabaseAwayError):  # then others notice that we are gone
                self.storage.transact(self._give_up_running, patience=0.0)
            self.storage.release_lease()

    def interrupt(self, number: int) -> None:
        """Let the running trials end at the first signal; end them at the second."""
        self.stop.at_once = bool(self.stop.signal_number) or number == signal.SIGTERM
        self.stop.signal_number = number
        self.stop.reason = f"stopped by {signal.Signals(number).name}"

    def _give_up_running(self) -> None:
        """Leave unfinished runs to the next process of the study."""
        for run in self.storage.runs():
            if run.state == RUNNING and run.owner == self.storage.owner:
                self.storage.write_run(run.with_(state=LOST, error="the study was stopped"))

    def _while_database_is_away(self, seconds: float) -> None:
        """Let jobs on other machines know that we listen; give up when asked to."""
        self._away_seconds += seconds
        self.pool.give_sign()
        if self.stop.at_once:
            error = DatabaseAwayError(f"{self.settings.study_name}: {self.stop.reason}.")
            error.exit_code = 128 + self.stop.signal_number
            raise error

    def _assign(self) -> bool:
        """Give all free workers a task; return whether the study continues."""
        if self.pool.has_room() or time.monotonic() > self._next_look:
            self.storage.transact(self._look_and_submit)
            self._next_look = time.monotonic() + _LOOK_SECONDS
        return self.pool.n_busy > 0 or not (self.stop.reason or self._finished)

    def _look_and_submit(self) -> None:
        self.storage.recover_lost_runs()
        self._reclaim_training()
        self._note_reasons_to_stop()
        self._cancel_eliminated()
        self._report_decided()
        while not self.stop.reason and self.pool.has_room():
            run = self._next_run()
            if run is None:
                break
            self.storage.write_run(run)
            self.pool.submit(run.number, self._task(run))
            self._training.add(run.number)

    def _reclaim_training(self) -> None:
        """Keep our runs that another process thought lost while the database was away."""
        for number in self._training:
            run = self.runs[number]
            if run.state == LOST:
                self.storage.write_run(run.with_(state=RUNNING, owner=self.storage.owner, error=""))

    def _next_run(self) -> Run | None:
        """Return the next run to start, already noted as running, or None for now."""
        for run in self.runs:
            if run.state == LOST:
                return self._started(run.with_(attempt=run.attempt + 1))
            # Written when the database went away, so that it never reached the pool.
            if run.state == RUNNING and self._is_ours(run) and run.number not in self._training:
                return run
        entries = self._entries()
        decision = race.next_action(
            entries,
            self.settings.rules,
            n_used=self.storage.history.n_searched,
            n_left=self.source.n_left(),
            try_all=self.source.is_exhaustive,
        )
        if decision.action == race.RUN:
            n_before = len(self.storage.history.by_trial.get(decision.number, ()))
            return self._new_run(decision.number, n_before)
        if decision.action == race.SUGGEST:
            number = self.source.suggest(len(entries))
            if number is not None:
                return self._new_run(number, 0)
        if decision.action == race.DONE or not any(r.state == RUNNING for r in self.runs):
            return self._next_final_run()
        return None

    def _next_final_run(self) -> Run | None:
        """Return the next run of the winner with a held-out seed, or end the study."""
        best = self.winner()
        if best is None or not self.settings.rules.racing:
            self._finished = True
            return None
        finals = [run for run in self.runs if run.is_final and run.trial == best]
        if len(finals) < self.settings.n_final_runs:
            return self._new_run(best, FINAL_REPEAT + len(finals))
        self._finished = not any(run.state == RUNNING for run in finals)
        return None

    def winner(self) -> int | None:
        """Return the number of the best configuration so far."""
        best = race.winner(self._entries(), self.settings.rules)
        return None if best is None else best.number

    def _new_run(self, trial: int, repeat: int) -> Run:
        purpose = ("repeat", repeat) if repeat < FINAL_REPEAT else ("held-out", repeat)
        seed = derive_seed(self.plan.seed, *purpose)
        return self._started(Run(len(self.runs), trial, repeat, seed, RUNNING, "", 0.0))

    def _started(self, run: Run) -> Run:
        return run.with_(state=RUNNING, owner=self.storage.owner, started=time.time(), error="")

    def _task(self, run: Run) -> Task:
        configuration = self.storage.configurations()[run.trial]
        return Task(
            (*self.plan.overrides, *self.space.overrides(configuration), f"seed={run.seed}"),
            self.plan.cfg.hyperopt_criterion,
            run.run_dir,
        )

    def _entries(self) -> list[race.Entry]:
        history = self.storage.history
        refused = {t.number for t in self.storage.trials(TrialState.FAIL)} - set(history.by_trial)
        return history.entries(set(self.storage.configurations()) - refused)

    def _is_ours(self, run: Run) -> bool:
        return run.owner == self.storage.owner

    def _handle_message(self, number: int, message: Message) -> None:
        run, content = self.runs[number], message.content
        if message.kind not in ("started", "evaluated"):
            self._training.discard(number)
        if not self._is_ours(run):  # another process took it over while the database was away
            if message.kind == "evaluated":
                self.pool.answer(number, False)
        elif message.kind == "started":
            self._change(run.with_(run_dir=content["run_dir"], place=content["place"]))
        elif message.kind == "evaluated":
            self.pool.answer(number, self._should_continue(run, content))
        elif message.kind == "finished":
            self._change(self._outcome(run, content))
        else:
            by_machine = message.kind == "died" or content["machine"]
            self._change(self._failure(run, content["error"], by_machine=by_machine))

    def _should_continue(self, run: Run, content: Mapping[str, Any]) -> bool:
        epoch, value = content["epoch"], content["value"]
        if run.is_final:
            return True
        weak = self.pruning.is_weak(run, epoch, value)
        others = self.storage.history.by_trial[run.trial].values()
        return not (weak or any(other.state in (PRUNED, FAILED) for other in others))

    def _outcome(self, run: Run, content: Mapping[str, Any]) -> Run:
        run = run.with_(
            values=tuple(content["values"]),
            steps=tuple(content["steps"]),
            seconds=content["seconds"],
            run_dir=content["run_dir"],
        )
        if content["status"] == "pruned":
            return run.with_(state=PRUNED)
        if content["status"] == "interrupted":
            return self._failure(run, "the worker was asked to stop", by_machine=True)
        cfg = self.plan.cfg
        curve = scores.Curve(run.steps, run.values, cfg.total_steps, cfg.early_stop_threshold)
        try:
            found = [scores.score(scores.find_score(s), curve) for s in self.settings.score]
        except Exception as error:  # noqa: BLE001 - also of the user's own function
            return self._failure(run, f"no score: {error}", by_machine=False)
        return run.with_(state=COMPLETE, scores=tuple(found))

    def _failure(self, run: Run, error: str, *, by_machine: bool) -> Run:
        again = by_machine and run.attempt < self.settings.max_retries
        seconds = time.time() - run.started
        return run.with_(state=LOST if again else FAILED, error=error, seconds=seconds)

    def _change(self, run: Run) -> None:
        def write() -> None:
            stored = self.storage.runs()[run.number]
            if (stored.identity, stored.owner) == (run.identity, run.owner):
                self.storage.write_run(run)

        self.storage.transact(write)

    def _end_late_runs(self) -> None:
        limit = self.settings.trial_timeout
        if limit is None:
            return
        for number in self.pool.kill_older_than(limit + self._away_seconds):
            self._training.discard(number)
            error = f"it ran longer than trial_timeout ({limit:g} s)"
            self._change(self._failure(self.runs[number], error, by_machine=False))

    def _cancel_eliminated(self) -> None:
        """Do not repeat a lost run whose configuration is eliminated by now."""
        lost = [run for run in self.runs if run.state == LOST and not run.is_final]
        for run in lost:
            if self.storage.history.entries([run.trial])[0].eliminated:
                error = "its configuration was eliminated already"
                self.storage.write_run(run.with_(state=PRUNED, error=error))

    def _report_decided(self) -> None:
        """Report configurations to the sampler that are eliminated or have their first repeats."""
        self.source.discard_torn()
        open_trials = {trial.number for trial in self.storage.trials(TrialState.RUNNING)}
        for entry in self._entries():
            if entry.number not in open_trials:
                continue
            runs = list(self.storage.history.by_trial.get(entry.number, {}).values())
            if entry.eliminated and not entry.n_running:
                self._report_eliminated(entry.number, runs)
            elif not entry.eliminated and len(entry.scores) >= self.settings.min_trials_per_param:
                self.storage.tell(entry.number, _mean_scores(runs))

    def _report_eliminated(self, trial: int, runs: Sequence[Run]) -> None:
        """Report a configuration to the sampler that failed or was pruned."""
        if any(run.state == FAILED for run in runs):
            self.storage.tell(trial, state=TrialState.FAIL)
            return
        suggested = self.source.suggested.get(trial)
        pruned = next(run for run in runs if run.state == PRUNED)
        if suggested is not None:  # how bad it was is what the sampler learns
            for epoch, value in enumerate(pruned.values, start=1):
                suggested.report(value, epoch)
        self.storage.tell(trial, state=TrialState.PRUNED)

    def _note_reasons_to_stop(self) -> None:
        self.pruning.learn_from(self.storage.history.take_changed())
        if self.stop.reason:
            return
        if self.storage.must_stop():
            self.stop.reason = "stopped by `scilab-rl study stop` or a file STOP"
        elif time.monotonic() > self.stop.deadline:
            self.stop.reason = f"stopped after {self.settings.max_duration_minutes:g} minutes"
        elif message := same_failure(self.runs, self.settings.fail_fast):
            self.stop.reason = (
                f"stopped because its first {self.settings.fail_fast} runs all failed: {message}"
            )


def same_failure(runs: Sequence[Run], count: int) -> str:
    """Return the message with which the first ``count`` finished runs all failed, or nothing.

    Numbers and paths in the message may differ. Runs that were stopped because their configuration
    had failed already say nothing.
    """
    broken = {run.trial for run in runs if run.state == FAILED}
    ended = [
        run
        for run in runs
        if run.state in (COMPLETE, FAILED) or (run.state == PRUNED and run.trial not in broken)
    ][:count]
    if not count or len(ended) < count or any(run.state != FAILED for run in ended):
        return ""
    kinds = {re.sub(r"\(details in .*|[\d.]+", "", run.error) for run in ended}
    return ended[0].error if len(kinds) == 1 else ""


def _mean_scores(runs: Sequence[Run]) -> list[float]:
    complete = [run.scores for run in runs if run.state == COMPLETE and not run.is_final]
    return [math.fsum(values) / len(values) for values in zip(*complete, strict=True)]
