"""The runs and the verdict of a performance test, stored as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scilab_rl.acceptance.rules import OPEN, Rule, Verdict, decide
from scilab_rl.files import write_json
from scilab_rl.run.directory import slug

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

    __test__ = False  # not a test class of pytest


@dataclass
class TestResult:
    """The result of one test.

    Attributes:
        name: For example ``FetchReach/sac_her-test``.
        definition: Conditions, configuration and code: runs with the same are comparable.
        runs: The finished runs by number.
        source: Versions, fingerprint and machine of its first run.
    """

    name: str
    definition: Mapping[str, Any]
    runs: dict[int, TestRun] = field(default_factory=dict)
    source: dict[str, Any] = field(default_factory=dict)

    __test__ = False

    @classmethod
    def from_json(cls, name: str, stored: Mapping[str, Any]) -> TestResult:
        """Read the form that `save` and a baseline write.

        Raises:
            KeyError, TypeError: If it has another form.
        """
        lists = ("curve_steps", "curve")
        runs = [TestRun(**run | {key: tuple(run[key]) for key in lists}) for run in stored["runs"]]
        return cls(name, stored["definition"], {run.number: run for run in runs}, stored["source"])

    def in_order(self) -> list[TestRun]:
        """Return the runs whose predecessors have all ended.

        Decisions come from these only: runs that end early are often the good ones.
        """
        ordered: list[TestRun] = []
        while len(ordered) in self.runs:
            ordered.append(self.runs[len(ordered)])
        return ordered

    def verdict(self, rule: Rule) -> Verdict:
        """Return the verdict of a rule; a failed run makes it an ``error``."""
        runs = self.in_order()
        values = [run.value for run in runs if run.value is not None]
        first_gap = next((i for i, run in enumerate(runs) if run.value is None), len(runs))
        verdict = decide(rule, values[:first_gap])
        if verdict.outcome == OPEN and len(values) < len(runs):
            return dataclasses.replace(verdict, outcome=ERROR)
        return verdict

    def save(self, base: Path) -> None:
        """Write the result below the folder of all runs."""
        path = state_file(self.name, base)
        path.parent.mkdir(parents=True, exist_ok=True)
        runs = [dataclasses.asdict(self.runs[number]) for number in sorted(self.runs)]
        write_json(
            path,
            {"name": self.name, "definition": self.definition, "source": self.source, "runs": runs},
        )


def load_result(name: str, base: Path) -> TestResult | None:
    """Return the stored result of a test, or None if there is none or it cannot be read."""
    try:
        stored = json.loads(state_file(name, base).read_text(encoding="utf-8"))
        return TestResult.from_json(name, stored)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def state_file(name: str, base: Path) -> Path:
    """Return the file of a test below the folder of all runs."""
    return base / "performance" / slug(name) / STATE_FILE
