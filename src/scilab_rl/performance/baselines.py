"""Results of performance tests as files of the repository, and what has changed since."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl.errors import ConfigError
from scilab_rl.files import write_json
from scilab_rl.performance.estimates import Estimate, difference
from scilab_rl.performance.gate import Verdict
from scilab_rl.performance.results import TestResult, TestRun

BASELINES = Path("baselines")
_FEWEST_RUNS = 3
# Of the packages of a run, those that decide what it learns and how fast.
_PACKAGES = (
    "scilab-rl", "torch", "numpy", "stable_baselines3", "sb3-contrib", "gymnasium",
    "gymnasium-robotics", "mujoco", "jax", "jaxlib", "optax", "metaworld", "highway-env",
)  # fmt: skip


@dataclass(frozen=True)
class Comparison:
    """What has become of a test since its baseline.

    Attributes:
        learning: Change of the mean over runs.
        speed: Training steps per second, new divided by old; None where they are not known.
        notes: What makes the two hard to compare.
        worse: Whether learning has worsened beyond chance.
        slower: Whether training has slowed down beyond chance, on the same kind of machine.
    """

    learning: Estimate
    speed: Estimate | None
    notes: tuple[str, ...] = ()
    worse: bool = False
    slower: bool = False

    def lines(self) -> list[str]:
        """Return what to tell."""
        word = "WORSE than the baseline" if self.worse else "against the baseline"
        told = [f"{word}: {self.learning.value:+.3g} in the mean {_range(self.learning)}"]
        if self.speed is not None:
            slower = "SLOWER" if self.slower else "speed"
            told.append(f"{slower}: {self.speed.value:.2f} times the steps/s {_range(self.speed)}")
        return [*told, *self.notes]


def baseline_file(name: str, folder: Path) -> Path:
    """Return the file of a test."""
    return folder / f"{name}.json"


def write_baseline(result: TestResult, verdict: Verdict, folder: Path) -> Path:
    """Store a result in the repository; paths of this machine stay out of it.

    Args:
        result: The finished test.
        verdict: Its verdict.
        folder: The folder of all baselines.
    """
    path = baseline_file(result.name, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    source = {key: value for key, value in result.source.items() if key != "versions"}
    versions = result.source.get("versions") or {}
    runs = [
        {k: v for k, v in dataclasses.asdict(run).items() if k not in ("run_dir", "error")}
        for run in result.in_order()
    ]
    write_json(
        path,
        {
            "name": result.name,
            "date": dt.date.today().isoformat(),
            "verdict": dataclasses.asdict(verdict),
            "definition": result.definition,
            "source": {
                **source,
                "versions": {name: versions[name] for name in _PACKAGES if name in versions},
            },
            "runs": runs,
        },
    )
    return path


def read_baseline(name: str, folder: Path) -> TestResult | None:
    """Return the baseline of a test, or None when there is none.

    Raises:
        ConfigError: If its file is damaged.
    """
    path = baseline_file(name, folder)
    if not path.is_file():
        return None
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        runs = [TestRun.from_json(run) for run in stored["runs"]]
        return TestResult(
            name, stored["definition"], {run.number: run for run in runs}, stored["source"]
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"The baseline '{path}' is damaged: {error}.") from error


def compare(new: TestResult, old: TestResult) -> Comparison | None:
    """Compare a result with its baseline; None where there are too few runs.

    A worsening is called one when the whole 95 % interval lies on the wrong side; so one test in
    forty reports one by chance.
    """
    ours, theirs = _values(old), _values(new)
    if min(len(ours), len(theirs)) < _FEWEST_RUNS:
        return None
    learning = difference([ours], [theirs], "mean", paired=False)
    speed = _speed(old, new)
    notes = _notes(new, old)
    same_machine = new.source.get("machine") == old.source.get("machine")
    return Comparison(
        learning,
        speed,
        tuple(notes),
        worse=learning.high < 0,
        slower=same_machine and speed is not None and speed.high < 1,
    )


def _values(result: TestResult) -> np.ndarray:
    return np.array([run.value for run in result.in_order() if run.value is not None])


def _speed(old: TestResult, new: TestResult) -> Estimate | None:
    before, after = _logs(old.in_order()), _logs(new.in_order())
    if min(len(before), len(after)) < _FEWEST_RUNS:
        return None
    ratio = difference([before], [after], "mean", paired=False)
    return Estimate(*(float(np.exp(v)) for v in (ratio.value, ratio.low, ratio.high)))


def _logs(runs: Sequence[TestRun]) -> np.ndarray:
    return np.log([run.steps_per_second for run in runs if run.steps_per_second])


def _notes(new: TestResult, old: TestResult) -> list[str]:
    notes = []
    if new.source.get("fingerprint") != old.source.get("fingerprint"):
        notes.append(
            "the environment does not behave as in the baseline (fingerprint "
            f"{new.source.get('fingerprint')}, was {old.source.get('fingerprint')})"
        )
    changed = _changes(old.definition["configuration"], new.definition["configuration"])
    if changed:
        notes.append(f"the configuration differs: {'; '.join(changed[:6])}")
    if new.source.get("machine") != old.source.get("machine"):
        notes.append("another machine: speeds do not compare")
    return notes


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    return [
        f"{key}: {new.get(key, 'absent')} (was {old.get(key, 'absent')})"
        for key in sorted({*old, *new})
        if old.get(key) != new.get(key)
    ]


def _range(estimate: Estimate) -> str:
    return f"(95 % interval {estimate.low:.3g} to {estimate.high:.3g})"
