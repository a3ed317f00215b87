"""Results of performance tests as files of the repository, and comparisons with them."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scilab_rl.acceptance.results import TestResult
from scilab_rl.acceptance.rules import Verdict
from scilab_rl.analysis.estimates import Estimate, difference
from scilab_rl.config.schema import learning_part
from scilab_rl.errors import ConfigError
from scilab_rl.files import write_json

BASELINES = Path("baselines")
_FEWEST_RUNS = 3
# The packages of a run that affect what it learns and how fast.
PACKAGES = (
    "scilab-rl", "torch", "numpy", "stable_baselines3", "sb3-contrib", "gymnasium",
    "gymnasium-robotics", "mujoco", "jax", "jaxlib", "optax", "metaworld", "highway-env",
)  # fmt: skip


@dataclass(frozen=True)
class BaselineComparison:
    """The change of a test since its baseline.

    Attributes:
        learning: Change of the mean over runs.
        speed: Training steps per second, new divided by old; None if unknown.
        notes: Reasons why the two are hard to compare.
        worse: Whether learning has worsened beyond chance.
        slower: Whether training has slowed down beyond chance, on the same kind of machine.
    """

    learning: Estimate
    speed: Estimate | None
    notes: tuple[str, ...] = ()
    worse: bool = False
    slower: bool = False

    def lines(self) -> list[str]:
        """Return the change in learning and speed, and the notes, one line each."""
        word = "WORSE than the baseline" if self.worse else "compared with the baseline"
        lines = [f"{word}: mean {self.learning.value:+.3g} {_range(self.learning)}"]
        if self.speed is not None:
            slower = "SLOWER" if self.slower else "speed"
            lines.append(f"{slower}: {self.speed.value:.2f} times the steps/s {_range(self.speed)}")
        return [*lines, *self.notes]


def write_baseline(result: TestResult, verdict: Verdict, folder: Path) -> Path:
    """Store a result in the repository, without paths of this machine.

    Args:
        result: The finished test.
        verdict: Its verdict.
        folder: The folder of all baselines.
    """
    path = folder / f"{result.name}.json"
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
                "versions": {name: versions[name] for name in PACKAGES if name in versions},
            },
            "runs": runs,
        },
    )
    return path


def read_baseline(name: str, folder: Path) -> TestResult | None:
    """Return the baseline of a test, or None if there is none.

    Raises:
        ConfigError: If its file is damaged.
    """
    path = folder / f"{name}.json"
    if not path.is_file():
        return None
    try:
        return TestResult.from_json(name, json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"The baseline '{path}' is damaged: {error}.") from error


def compare(new: TestResult, old: TestResult) -> BaselineComparison | None:
    """Compare a result with its baseline; None if there are too few runs.

    A test is worse, or slower, if the whole 95 % interval lies below the baseline. By chance, one
    test in forty is.
    """
    ours, theirs = (
        np.array([run.value for run in result.in_order() if run.value is not None])
        for result in (old, new)
    )
    if min(len(ours), len(theirs)) < _FEWEST_RUNS:
        return None
    learning = difference([ours], [theirs], "mean", paired=False)
    speed = _speed(old, new)
    same_machine = new.source.get("machine") == old.source.get("machine")
    return BaselineComparison(
        learning,
        speed,
        tuple(_notes(new, old)),
        worse=learning.high < 0,
        slower=same_machine and speed is not None and speed.high < 1,
    )


def _speed(old: TestResult, new: TestResult) -> Estimate | None:
    before, after = (
        np.log([run.steps_per_second for run in result.in_order() if run.steps_per_second])
        for result in (old, new)
    )
    if min(len(before), len(after)) < _FEWEST_RUNS:
        return None
    ratio = difference([before], [after], "mean", paired=False)
    return Estimate(*(float(np.exp(v)) for v in (ratio.value, ratio.low, ratio.high)))


def _notes(new: TestResult, old: TestResult) -> list[str]:
    notes = []
    if new.source.get("fingerprint") != old.source.get("fingerprint"):
        notes.append(
            "the environment behaves differently from the baseline (fingerprint "
            f"{new.source.get('fingerprint')}, was {old.source.get('fingerprint')})"
        )
    before, now = (learning_part(made.definition["configuration"]) for made in (old, new))
    changed = [
        f"{key}: {now.get(key, 'absent')} (was {before.get(key, 'absent')})"
        for key in sorted({*before, *now})
        if before.get(key) != now.get(key)
    ]
    if changed:
        notes.append(f"the configuration differs: {'; '.join(changed[:6])}")
    if new.source.get("machine") != old.source.get("machine"):
        notes.append("another machine: speeds cannot be compared")
    return notes


def _range(estimate: Estimate) -> str:
    return f"(95 % interval {estimate.low:.3g} to {estimate.high:.3g})"
