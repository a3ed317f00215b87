"""The course of a study: give each free worker the next run, note what comes back, decide again."""

from __future__ import annotations

import math
import re
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from optuna.trial import TrialState

from scilab_rl.hyperopt import race, scores
from scilab_rl.hyperopt.jobs import JobPool
from scilab_rl.hyperopt.ledger import Ledger
from scilab_rl.hyperopt.pool import Pool
from scilab_rl.hyperopt.pruning import Pruning
from scilab_rl.hyperopt.runs import (
    COMPLETE,
    FAILED,
    FINAL_REPEAT,
    LOST,
    PRUNED,
    RUNNING,
    Run,
    entries_of,
)
from scilab_rl.hyperopt.settings import StudySettings
from scilab_rl.hyperopt.source import SettingsSource, settings_of
from scilab_rl.hyperopt.space import SearchSpace, Setting
from scilab_rl.hyperopt.worker import Message, Task
from scilab_rl.seeding import derive_seed

_POLL_SECONDS = 0.5
_LOOK_SECONDS = 1.0  # how often the ledger is read while all workers are busy


@dataclass(frozen=True)
class RunPlan:
    """What all runs of a study have in common.

    Attributes:
        overrides: The fixed part of their configuration, as typed on a command line.
        criterion: The metric to score.
        n_epochs: Evaluations of a whole run.
        budget_steps: Environment steps of a whole run.
        threshold: For the score ``steps_to_threshold``.
        seed: Seed of the study; equal repeats of all settings share the seed derived from it.
        present: Their setting if nothing were searched, where the space holds it.
    """

    overrides: tuple[str, ...]
    criterion: str
    n_epochs: int
    budget_steps: int
    threshold: float
    seed: int
    present: Setting | None = None


@dataclass
class StopReasons:
    """Why no further run is started.

    Attributes:
        reason: Empty as long as the study goes on.
        signal_number: The signal that asked for it, or 0.
        at_once: Whether the running trials shall not be waited for.
        deadline: Monotonic time, in seconds, at which it is too late for another run.
    """

    reason: str = ""
    signal_number: int = 0
    at_once: bool = False
    deadline: float = math.inf


class Study:
    """Runs a study to its end, or to where somebody stops it.

    Args:
        ledger: Its memory, shared with other processes.
        pool: What trains the runs: workers of this process, or jobs of a scheduler.
        space: The search space.
        settings: What the study shall do.
        plan: What all runs have in common.
        observer: Told about all runs whenever something has happened.
    """

    def __init__(
        self,
        ledger: Ledger,
        pool: Pool | JobPool,
        space: SearchSpace,
        settings: StudySettings,
        plan: RunPlan,
        observer: Any = None,
    ) -> None:
        self.ledger = ledger
        self.pool = pool
        self.space = space
        self.settings = settings
        self.plan = plan
        self.observer = observer
        self.stop = StopReasons()
        self.runs: list[Run] = []
        self.source = SettingsSource(
            ledger, space, settings.sampler, plan.seed, settings.rules, plan.present
        )
        self.pruning = Pruning(
            settings.pruner if settings.rules.racing else "none",
            settings.pruner_warmup_epochs,
            plan.n_epochs,
            maximize=settings.rules.maximize,
        )
        self._finished = False
        self._next_look = 0.0

    def work(self) -> None:
        """Train until the study is over; the ledger then holds everything."""
        if self.settings.max_duration_minutes is not None:
            self.stop.deadline = time.monotonic() + 60 * self.settings.max_duration_minutes
        with self.ledger.locked():
            self.ledger.sign()
            self.ledger.allow_running()
        try:
            while self._assign() and not self.stop.at_once:
                for number, message in self.pool.messages(_POLL_SECONDS):
                    self._hear(number, message)
                self._end_late_runs()
                if self.observer is not None:
                    self.observer.update(self.runs)
        finally:
            self._give_up_running()
            self.ledger.withdraw()

    def interrupt(self, number: int) -> None:
        """Let the running trials end at the first signal; end them at the second."""
        self.stop.at_once = bool(self.stop.signal_number) or number == signal.SIGTERM
        self.stop.signal_number = number
        self.stop.reason = f"stopped by {signal.Signals(number).name}"

    def _give_up_running(self) -> None:
        """Leave what could not end to whoever continues the study."""
        self.pool.kill_all()
        with self.ledger.locked():
            for run in self.runs:
                if run.state == RUNNING and run.owner == self.ledger.owner:
                    self._store(run.with_(state=LOST, error="the study was stopped"))

    def _assign(self) -> bool:
        """Give all free workers something to do and tell whether the study goes on."""
        if self.pool.has_room() or time.monotonic() > self._next_look:
            self._look_and_submit()
            self._next_look = time.monotonic() + _LOOK_SECONDS
        return self.pool.n_busy > 0 or not (self.stop.reason or self._finished)

    def _look_and_submit(self) -> None:
        with self.ledger.locked():
            self.runs = self.ledger.recover_lost_runs(self.ledger.runs())
            self._note_reasons_to_stop()
            self._drop_pointless()
            self._tell_decided()
            while not self.stop.reason and self.pool.has_room():
                run = self._next_run()
                if run is None:
                    break
                self._store(run)
                self.pool.submit(run.number, self._task(run))

    def _next_run(self) -> Run | None:
        """Return the next run to start, already noted as running, or None for now."""
        for run in self.runs:
            if run.state == LOST:
                return self._started(run.with_(attempt=run.attempt + 1))
        entries = self._entries()
        decision = race.decide(
            entries,
            self.settings.rules,
            n_used=sum(not run.is_final for run in self.runs),
            n_left=self.source.n_left(),
            try_all=self.source.is_exhaustive,
        )
        if decision.action == race.RUN:
            return self._new_run(decision.number, self._next_repeat(decision.number))
        if decision.action == race.ASK:
            number = self.source.ask(len(entries))
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
        """Return the number of the best setting so far."""
        best = race.winner(self._entries(), self.settings.rules)
        return None if best is None else best.number

    def _new_run(self, trial: int, repeat: int) -> Run:
        purpose = ("repeat", repeat) if repeat < FINAL_REPEAT else ("held-out", repeat)
        seed = derive_seed(self.plan.seed, *purpose)
        return self._started(Run(len(self.runs), trial, repeat, seed, RUNNING, "", 0.0))

    def _started(self, run: Run) -> Run:
        return run.with_(state=RUNNING, owner=self.ledger.owner, started=time.time(), error="")

    def _next_repeat(self, trial: int) -> int:
        return 1 + max(
            (run.repeat for run in self.runs if run.trial == trial and not run.is_final), default=-1
        )

    def _task(self, run: Run) -> Task:
        setting = settings_of(self.ledger.trials())[run.trial]
        return Task(
            (*self.plan.overrides, *self.space.overrides(setting), f"seed={run.seed}"),
            self.plan.criterion,
            run.run_dir,
        )

    def _entries(self) -> list[race.Entry]:
        with_runs = {run.trial for run in self.runs}
        trials = self.ledger.trials()
        refused = {t.number for t in trials if t.state == TrialState.FAIL} - with_runs
        return entries_of(self.runs, set(settings_of(trials)) - refused)

    def _store(self, run: Run) -> None:
        self.ledger.write_run(run)
        self.runs = [*self.runs[: run.number], run, *self.runs[run.number + 1 :]]

    def _hear(self, number: int, message: Message) -> None:
        run, content = self.runs[number], message.content
        if message.kind == "started":
            self._change(run.with_(run_dir=content["run_dir"]))
        elif message.kind == "evaluated":
            self.pool.answer(number, self._may_go_on(run, content))
        elif message.kind == "finished":
            self._change(self._outcome(run, content))
        else:
            by_machine = message.kind == "died" or content["machine"]
            self._change(self._failure(run, content["error"], by_machine=by_machine))

    def _may_go_on(self, run: Run, content: Mapping[str, Any]) -> bool:
        epoch, value = content["epoch"], content["value"]
        if run.is_final:
            return True
        hopeless = self.pruning.is_hopeless(run, epoch, value)
        others_out = any(
            other.trial == run.trial and other.state in (PRUNED, FAILED) for other in self.runs
        )
        return not (hopeless or others_out)

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
            return self._failure(run, "the worker was told to stop", by_machine=True)
        curve = scores.Curve(run.steps, run.values, self.plan.budget_steps, self.plan.threshold)
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
        with self.ledger.locked():
            self._store(run)
        self.pruning.learn_from([run])

    def _end_late_runs(self) -> None:
        limit = self.settings.trial_timeout
        if limit is None:
            return
        for number in self.pool.kill_older_than(limit):
            error = f"it ran longer than trial_timeout ({limit:g} s)"
            self._change(self._failure(self.runs[number], error, by_machine=False))

    def _drop_pointless(self) -> None:
        """Do not repeat a lost run whose setting is out by now."""
        out = {entry.number for entry in self._entries() if entry.out}
        for run in self.runs:
            if run.state == LOST and run.trial in out and not run.is_final:
                self._store(run.with_(state=PRUNED, error="its setting was out already"))

    def _tell_decided(self) -> None:
        """Tell the sampler about settings whose first repeats are done, or that are out."""
        self.source.discard_torn()
        open_trials = {trial.number for trial in self.ledger.trials(TrialState.RUNNING)}
        for entry in self._entries():
            if entry.number not in open_trials:
                continue
            runs = [run for run in self.runs if run.trial == entry.number]
            if entry.out and not entry.n_running:
                self._tell_out(entry.number, runs)
            elif not entry.out and len(entry.scores) >= self.settings.min_trials_per_param:
                self.ledger.tell(entry.number, _mean_scores(runs))

    def _tell_out(self, trial: int, runs: Sequence[Run]) -> None:
        """Tell the sampler about a setting that failed or was pruned."""
        if any(run.state == FAILED for run in runs):
            self.ledger.tell(trial, state=TrialState.FAIL)
            return
        asked = self.source.asked.get(trial)
        pruned = next(run for run in runs if run.state == PRUNED)
        if asked is not None:  # how bad it was is what the sampler learns
            for epoch, value in enumerate(pruned.values, start=1):
                asked.report(value, epoch)
        self.ledger.tell(trial, state=TrialState.PRUNED)

    def _note_reasons_to_stop(self) -> None:
        self.pruning.learn_from(self.runs)
        if self.stop.reason:
            return
        if self.ledger.must_stop():
            self.stop.reason = "stopped because its stop file was deleted"
        elif time.monotonic() > self.stop.deadline:
            self.stop.reason = f"stopped after {self.settings.max_duration_minutes:g} minutes"
        elif message := same_failure(self.runs, self.settings.fail_fast):
            self.stop.reason = (
                f"stopped because its first {self.settings.fail_fast} runs all failed: {message}"
            )


def same_failure(runs: Sequence[Run], count: int) -> str:
    """Return the message with which the first ``count`` finished runs all failed, or nothing.

    Numbers and paths in the message may differ. Runs that were stopped because their setting had
    failed already say nothing.
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
