"""Train the runs of performance tests, several at a time, until each test is decided."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import math
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scilab_rl import machine
from scilab_rl.acceptance.conditions import REFERENCE, Conditions, read_conditions
from scilab_rl.acceptance.results import TestResult, TestRun, load_result
from scilab_rl.acceptance.rules import OPEN
from scilab_rl.config.compose import compose
from scilab_rl.config.schema import learning_config, learning_part
from scilab_rl.errors import ScilabRLError
from scilab_rl.parallel.jobs import JobPool
from scilab_rl.parallel.pool import Pool
from scilab_rl.parallel.progress import Progress
from scilab_rl.parallel.worker import Message, Task
from scilab_rl.run.checks import complete
from scilab_rl.run.directory import RunDirectory, read_epochs
from scilab_rl.run.provenance import PROVENANCE_FILE
from scilab_rl.seeding import derive_seed

_log = logging.getLogger(__name__)
_POLL_SECONDS = 0.5
_MOST_ATTEMPTS = 3  # if the machine, not the run, is to blame
_SOURCES = ("algorithms", "learning", "training", "envs", "metrics")


class TestsInterruptedError(ScilabRLError):
    """A signal has stopped the tests; finished runs are kept."""

    exit_code = 130
    __test__ = False  # not a test class of pytest


@dataclass(frozen=True)
class PerformanceTest:
    """A performance test, composed and checked.

    Attributes:
        name: For example ``FetchReach/sac_her-test``.
        overrides: The configuration of its runs, without the seed.
        conditions: Their target.
        env: Id of the environment.
        algorithm: Name of the algorithm.
        base: The folder of all runs.
        definition: Conditions, configuration and code: runs with the same are comparable.
    """

    name: str
    overrides: tuple[str, ...]
    conditions: Conditions
    env: str
    algorithm: str
    base: Path
    definition: Mapping[str, Any]

    def task(self, number: int) -> Task:
        """Return the training run of this number."""
        judged_apart = self.conditions.rule != REFERENCE
        return Task(
            (*self.overrides, f"seed={self.seed(number)}"),
            self.conditions.eval_columns,
            n_final_episodes=self.conditions.n_episodes if judged_apart else 0,
        )

    def seed(self, number: int) -> int:
        """Return the seed of a run, which is always the same, so that results can be paired."""
        return derive_seed(self.conditions.seed, "performance", number)


def read_test(name: str, overrides: Sequence[str], rule: str | None = None) -> PerformanceTest:
    """Compose and check a test; nothing is started.

    Args:
        name: Of the test.
        overrides: The command line, with ``+performance=NAME``.
        rule: Replaces the rule of the file.

    Raises:
        ConfigError: If the test is invalid.
    """
    cfg = compose(overrides)
    conditions = read_conditions(cfg.performance_testing_conditions, name, rule)
    epoch_steps = min(cfg.eval_after_n_steps, conditions.max_steps)
    words = (
        *overrides,
        f"eval_after_n_steps={epoch_steps}",
        f"n_epochs={math.ceil(conditions.max_steps / epoch_steps)}",
        f"early_stop_data_column={conditions.eval_columns}",
        f"early_stop_threshold={conditions.stop_value:.12g}",
        f"hyperopt_criterion={conditions.eval_columns}",
        f"group={cfg.group or name.replace('/', '_')}",
        "++tracking.console.enabled=false",  # many runs at once: the tests report for them
    )
    cfg = complete(compose(words))
    definition = {
        # What is stated about the cost decides nothing.
        "conditions": {k: v for k, v in dataclasses.asdict(conditions).items() if k != "hours"},
        "configuration": learning_config(cfg.values()),
        "code": code_digest(),
    }
    return PerformanceTest(
        name, words, conditions, cfg.env, cfg.algorithm.name, Path(cfg.base_logdir),
        json.loads(json.dumps(definition)),
    )  # fmt: skip


def code_digest() -> str:
    """Return a digest of the code that affects learning, of framework and project."""
    package = Path(__file__).parents[1]
    folders = [package / name for name in _SOURCES]
    folders += [Path("src/custom_algorithms"), Path("src/custom_envs")]
    digest = hashlib.sha256()
    for path in sorted(path for folder in folders for path in folder.rglob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


class PerformanceTestRunner:
    """Runs performance tests.

    Args:
        tests: The tests, which continue where an earlier call stopped.
        pool: Where runs are trained.
        fresh: Whether to ignore existing results.
        any_code: Whether to keep results of earlier code.
    """

    def __init__(
        self,
        tests: Sequence[PerformanceTest],
        pool: Pool | JobPool,
        *,
        fresh: bool = False,
        any_code: bool = False,
    ) -> None:
        self.tests = tests
        self.pool = pool
        self.rules = [test.conditions.make_rule() for test in tests]
        self.results = [_stored_result(test, fresh, any_code) for test in tests]
        self.signal_number = 0
        self.progress = Progress()
        self._running: dict[int, tuple[int, int]] = {}  # job -> test, run
        self._folders: dict[int, str] = {}
        self._attempts: dict[tuple[int, int], int] = {}
        self._n_jobs = 0

    def work(self) -> list[TestResult]:
        """Train until every test is decided.

        Returns:
            The results, in the order of the tests.

        Raises:
            TestsInterruptedError: If a signal has stopped the tests.
        """
        with _signals_to(self), self.progress:
            while not self.signal_number and (self._submit() or self._running):
                self.progress.show([self.state()])
                for job, message in self.pool.messages(_POLL_SECONDS):
                    self._handle(job, message)
        if self.signal_number:
            self.pool.kill_all()
            raise TestsInterruptedError("Interrupted; the same command continues the tests.")
        return self.results

    def is_open(self, index: int) -> bool:
        """Return whether a test needs more runs."""
        return self.results[index].verdict(self.rules[index]).outcome == OPEN

    def state(self) -> str:
        """Return how far the tests are, and how long the rest takes.

        A test needs between its fewest and its most runs; each takes as long as the others of the
        test, or of all tests while it has none.
        """
        still_open = [index for index in range(len(self.tests)) if self.is_open(index)]
        n_decided = len(self.tests) - len(still_open)
        text = f"{n_decided} of {len(self.tests)} tests decided, {len(self._running)} runs train"
        times = [self._seconds_per_run(index) for index in still_open]
        if not times or not all(times):
            return text
        minutes = [
            sum(
                seconds * max(limit(self.rules[index]) - len(self.results[index].runs), 1)
                for seconds, index in zip(times, still_open, strict=True)
            )
            / self.pool.size
            / 60
            for limit in (lambda rule: rule.min_runs, lambda rule: rule.max_runs)
        ]
        return f"{text}, between {minutes[0]:.0f} and {minutes[1]:.0f} min left"

    def _seconds_per_run(self, index: int) -> float:
        """Return the mean duration of the runs of a test, else of all; 0 when there is none."""
        own = [run.seconds for run in self.results[index].runs.values() if run.seconds]
        every = [run.seconds for result in self.results for run in result.runs.values()]
        times = own or [seconds for seconds in every if seconds]
        return math.fsum(times) / len(times) if times else 0.0

    def _submit(self) -> bool:
        """Fill the pool; return whether any test is open."""
        while self.pool.has_room() and (chosen := self._next_run()) is not None:
            index, number = chosen
            self._running[self._n_jobs] = chosen
            self.pool.submit(self._n_jobs, self.tests[index].task(number))
            self._n_jobs += 1
        return any(map(self.is_open, range(len(self.tests))))

    def _next_run(self) -> tuple[int, int] | None:
        """Return test and number of the run to train next.

        Tests are decided one after the other. Runs that may turn out to be unnecessary come after
        those that are certainly needed.
        """
        under_way = list(self._running.values())
        busy = {test for test, _ in under_way}
        candidates = []
        for index, result in enumerate(self.results):
            taken = {number for test, number in under_way if test == index} | set(result.runs)
            number = next(i for i in range(len(taken) + 1) if i not in taken)
            if self.is_open(index) and number < self.rules[index].max_runs:
                is_certain = number < self.rules[index].min_runs or index not in busy
                candidates.append((not is_certain, index, number))
        return min(candidates)[1:] if candidates else None

    def _handle(self, job: int, message: Message) -> None:
        index, number = self._running[job]
        if message.kind == "evaluated":
            self.pool.answer(job, self.is_open(index))
        elif message.kind == "started":
            self._folders[job] = message.content["run_dir"]
        else:
            del self._running[job]
            self._end(index, number, self._folders.pop(job, ""), message)

    def _end(self, index: int, number: int, folder: str, message: Message) -> None:
        test, result = self.tests[index], self.results[index]
        if not self.is_open(index):
            return  # decided in the meantime
        if message.kind == "finished":
            run = _finished_run(test, number, message.content)
        else:
            attempts = self._attempts[index, number] = self._attempts.get((index, number), 0) + 1
            is_machine_failure = message.kind == "died" or message.content.get("machine")
            if is_machine_failure and attempts < _MOST_ATTEMPTS:
                return  # its number is free again
            error = str(message.content["error"])
            run = TestRun(number, test.seed(number), run_dir=folder, error=error)
        result.runs[number] = run
        if not result.source and run.run_dir:
            result.source = read_source(Path(run.run_dir))
        result.save(test.base)
        self._report(index, run)

    def _report(self, index: int, run: TestRun) -> None:
        test = self.tests[index]
        verdict = self.results[index].verdict(self.rules[index])
        score = f"{run.value:.3g}" if run.value is not None else f"FAILED: {run.error}"
        mean = f"mean {verdict.mean:.3g} of {verdict.n_runs}" if verdict.n_runs else "no mean yet"
        self.progress.say(
            f"{test.name}, run {run.number + 1}: {score} after {run.steps:,} steps and "
            f"{run.seconds:.0f} s; {mean}, target {test.conditions.eval_value:.3g}: "
            f"{verdict.outcome}."
        )


def read_source(run_dir: Path) -> dict[str, object]:
    """Return the provenance of a run: versions, fingerprint, commit and machine."""
    try:
        stored = json.loads((run_dir / PROVENANCE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        stored = {}
    kept = ("git_commit", "git_changed", "fingerprint", "python", "platform", "versions")
    return {
        **{key: stored.get(key) for key in kept},
        "machine": machine.describe(),
    }


def _stored_result(test: PerformanceTest, fresh: bool, any_code: bool) -> TestResult:
    new = TestResult(test.name, test.definition)
    known = None if fresh else load_result(test.name, test.base)
    if known is None:
        return new
    before = dict(known.definition)
    before["configuration"] = learning_part(before["configuration"])
    changed = [key for key in test.definition if before.get(key) != test.definition[key]]
    if any_code and changed == ["code"]:
        changed = []
    if changed:
        _log.info("%s: its %s changed; the test restarts.", test.name, " and ".join(changed))
        return new
    known.runs = {n: run for n, run in known.runs.items() if run.value is not None}
    return known


def _finished_run(test: PerformanceTest, number: int, content: Mapping[str, Any]) -> TestRun:
    rows = read_epochs(RunDirectory(Path(content["run_dir"])))
    training = math.fsum(row.get("time/train_seconds", 0.0) for row in rows)
    final = content.get("final")
    steps = content["steps"][-1] if content["steps"] else 0
    return TestRun(
        number=number,
        seed=test.seed(number),
        value=content["values"][-1] if final is None else final,
        steps=steps,
        seconds=round(content["seconds"], 1),
        steps_per_second=round(steps / training, 2) if training else None,
        curve_steps=tuple(content["steps"]),
        curve=tuple(round(value, 4) for value in content["values"]),
        run_dir=content["run_dir"],
    )


@contextlib.contextmanager
def _signals_to(runner: PerformanceTestRunner) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM stop the tests gracefully within the block."""

    def stop(number: int, _: object) -> None:
        runner.signal_number = number

    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
