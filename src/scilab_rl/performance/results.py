"""What a performance test has found: its runs and its verdict, kept as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scilab_rl.files import write_json
from scilab_rl.performance.gate import OPEN, Rule, Verdict, decide
from scilab_rl.results import slug

STATE_FILE = "state.json"
ERROR = "error"


@dataclass(frozen=True)
class TestRun:
    """One training run of a test.

    Attributes:
        number: From 0, in the order of the seeds.
        seed: Its seed.
        value: The metric of the finished policy; None when the run failed.
        steps: Environment steps until it ended.
        seconds: Wall time of the training with its evaluations.
        steps_per_second: Steps per second of training, without evaluations.
        curve_steps: Steps at each evaluation.
        curve: The metric at each evaluation. Shapes: as ``curve_steps``.
        run_dir: Folder of the run.
        error: Why it failed.
    """

    number: int
    seed: int
    value: float | None = None
    steps: int = 0
    seconds: float = 0.0
    steps_per_second: float | None = None
    curve_steps: tuple[int, ...] = ()
    curve: tuple[float, ...] = ()
    run_dir: str = ""
    error: str | None = None

    __test__ = False  # no test class of pytest

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> TestRun:
        """Read what `dataclasses.asdict` has written."""
        lists = {key: tuple(stored[key]) for key in ("curve_steps", "curve")}
        return cls(**{**stored, **lists})


@dataclass
class TestResult:
    """The memory of one test.

    Attributes:
        name: For example ``FetchReach/sac_her-test``.
        definition: What makes its runs comparable: conditions, configuration, code.
        runs: The finished runs by number.
        source: Versions, fingerprint and machine of its first run.
    """

    name: str
    definition: Mapping[str, Any]
    runs: dict[int, TestRun] = field(default_factory=dict)
    source: dict[str, Any] = field(default_factory=dict)

    __test__ = False

    def in_order(self) -> list[TestRun]:
        """Return the runs whose predecessors have all ended.

        Decisions come from these only: runs that end early are often the good ones.
        """
        ordered: list[TestRun] = []
        while len(ordered) in self.runs:
            ordered.append(self.runs[len(ordered)])
        return ordered

    def verdict(self, rule: Rule) -> Verdict:
        """Return what the rule says; a run that failed makes it an ``error``."""
        runs = self.in_order()
        values = [run.value for run in runs if run.value is not None]
        verdict = decide(rule, values[: _first_gap(runs)])
        if verdict.outcome == OPEN and len(values) < len(runs):
            return dataclasses.replace(verdict, outcome=ERROR)
        return verdict

    def save(self, base: Path) -> None:
        """Write the file."""
        path = state_file(self.name, base)
        path.parent.mkdir(parents=True, exist_ok=True)
        runs = [dataclasses.asdict(self.runs[number]) for number in sorted(self.runs)]
        write_json(
            path,
            {"name": self.name, "definition": self.definition, "source": self.source, "runs": runs},
        )


def load_result(name: str, base: Path) -> TestResult | None:
    """Return what is known of a test, or None."""
    try:
        stored = json.loads(state_file(name, base).read_text(encoding="utf-8"))
        runs = [TestRun.from_json(run) for run in stored["runs"]]
        return TestResult(
            name, stored["definition"], {run.number: run for run in runs}, stored["source"]
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None


def state_file(name: str, base: Path) -> Path:
    """Return the file of a test below the folder of all runs."""
    return base / "performance" / slug(name) / STATE_FILE


def _first_gap(runs: Sequence[TestRun]) -> int:
    return next((i for i, run in enumerate(runs) if run.value is None), len(runs))
