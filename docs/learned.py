"""Write the tables of docs/environments.md from the cards of agents and the stored baselines.

python -m docs.learned
"""

from __future__ import annotations

import json
import re
import statistics
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docs.generate import table

from scilab_rl import files
from scilab_rl.acceptance.agents import CARD_FILE, PAGE_FILE, read_card
from scilab_rl.acceptance.conditions import stated
from scilab_rl.acceptance.rules import PASS
from scilab_rl.config.workspace import SHIPPED_AGENTS, SHIPPED_CONF

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "environments.md"
BASELINES = ROOT / "baselines"
_MARKS = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class Result:
    """What one recipe has learned of one task.

    Attributes:
        task: Environment and its arguments.
        algorithm: The algorithm's name.
        metric: ``success`` or ``return``.
        mean: Mean over new episodes.
        low: Lower end of its interval.
        high: Upper end.
        steps: Environment steps of training; of several runs the median.
        minutes: Of training with evaluations; of several runs the median.
        measured: How often and in how many episodes.
        outcome: ``pass``, ``fail`` or ``inconclusive``; empty for an agent, which is no test.
        target: What the test demands; empty for an agent.
        link: To the card or baseline.
    """

    task: str
    algorithm: str
    metric: str
    mean: float
    low: float
    high: float
    steps: float
    minutes: float
    measured: str
    outcome: str
    target: str
    link: str


def of_agents() -> Iterator[Result]:
    """Yield what each shipped agent has learned, from its card."""
    for file in sorted(SHIPPED_AGENTS.glob(f"*/{CARD_FILE}")):
        card = read_card(file.parent)
        evaluation, training = card["evaluation"], card["training"]
        metric = "success" if "success" in evaluation else "return"
        found = evaluation[metric]
        yield Result(
            task=_task(card["env"], card["env_kwargs"]),
            algorithm=card["algorithm"],
            metric=metric,
            mean=found["mean"],
            low=found["low"],
            high=found["high"],
            steps=training["steps"],
            minutes=training["minutes"],
            measured=f"1 run, {evaluation['episodes']:,} episodes",
            outcome="",
            target="",
            link=f"[card](../src/scilab_rl/agents/{file.parent.name}/{PAGE_FILE})",
        )


def of_tests() -> Iterator[Result]:
    """Yield what the runs of each performance test with a baseline have learned."""
    for path in sorted(BASELINES.glob("*/*.json")):
        stored = json.loads(path.read_text(encoding="utf-8"))
        verdict, runs = stored["verdict"], stored["runs"]
        conditions = stored["definition"]["conditions"]
        values = {k: json.loads(v) for k, v in stored["definition"]["configuration"].items()}
        kwargs = {
            key.removeprefix("env_kwargs."): value
            for key, value in values.items()
            if key.startswith("env_kwargs.")
        }
        yield Result(
            task=_task(values["env"], kwargs),
            algorithm=values["algorithm.name"],
            metric="success" if "success" in conditions["eval_columns"] else "return",
            mean=verdict["mean"],
            low=verdict["low"],
            high=verdict["high"],
            steps=statistics.median(run["steps"] for run in runs),
            minutes=statistics.median(run["seconds"] for run in runs) / 60,
            measured=f"{verdict['n_runs']} runs, {conditions['n_episodes']} episodes each",
            outcome=verdict["outcome"],
            target=f"{conditions['eval_value']:g} within {conditions['max_steps']:,} steps",
            link=f"[`{stored['name']}`](../{path.relative_to(ROOT)})",
        )


def best_table() -> Iterator[str]:
    """Yield the table of the best recipe of each task, and of each test that does not pass."""
    results = [*of_agents(), *of_tests()]
    tasks = sorted({result.task for result in results})
    rows = [row for task in tasks for row in _rows([r for r in results if r.task == task])]
    columns = ("task", "algorithm", "result", "95 % interval", "steps", "minutes", "measured in")
    yield from table((*columns, "outcome", "from"), rows)
    untested = sorted(set(_shipped_tests()) - {path.as_posix() for path in _names()})
    yield (
        f"Shipped performance tests without a stored result ({len(untested)}), with about the "
        "hours of one core that three runs take:"
    )
    yield ", ".join(f"`{name}` ({_hours(name):g})" for name in untested) + "."


def tests_table() -> Iterator[str]:
    """Yield the table of all performance tests with a baseline."""
    columns = ("performance test", "algorithm", "target", "result", "95 % interval", "steps")
    rows = [
        (result.link, f"`{result.algorithm}`", f"{result.metric} {result.target}",
         f"{result.mean:.3g}", _interval(result), f"{result.steps:,.0f}", f"{result.minutes:.1f}",
         result.measured, result.outcome)
        for result in of_tests()
    ]  # fmt: skip
    yield from table((*columns, "minutes", "measured in", "outcome"), rows)


def _hours(name: str) -> float:
    path = SHIPPED_CONF / "performance" / f"{name}.yaml"
    return float(str(stated(path, "hours")))


TABLES = {"learned": best_table, "tests": tests_table}


def with_tables(page: str) -> str:
    """Return the text of the page with its tables as the stored results are now."""
    return _MARKS.sub(lambda m: f"{m[1]}{_text(TABLES[m[2]]())}{m[3]}", page)


def _rows(results: Sequence[Result]) -> Iterator[Iterable[str]]:
    """Yield the best of the results of one task, then the tests that have not passed."""
    good = [r for r in results if r.outcome in ("", PASS)]
    ranked = sorted(good, key=lambda r: (r.metric != "success", -round(r.mean, 2), r.minutes))
    for best in ranked[:1]:
        cards = [r.link for r in good if not r.outcome and r is not best]
        yield _row(best, ", ".join([best.link, *cards]))
    for result in results:
        if result not in good:
            yield _row(result, result.link)


def _row(result: Result, links: str) -> Iterable[str]:
    return (
        f"`{result.task}`", f"`{result.algorithm}`", f"{result.metric} {result.mean:.3g}",
        _interval(result), f"{result.steps:,.0f}", f"{result.minutes:.1f}", result.measured,
        result.outcome or "-", links,
    )  # fmt: skip


def _interval(result: Result) -> str:
    return f"{result.low:.3g} to {result.high:.3g}"


def _task(env: str, kwargs: Mapping[str, Any]) -> str:
    return " ".join([env, *(f"{key}={value}" for key, value in sorted(kwargs.items()))])


def _names() -> Iterator[Path]:
    return (path.relative_to(BASELINES).with_suffix("") for path in BASELINES.glob("*/*.json"))


def _shipped_tests() -> Iterator[str]:
    folder = SHIPPED_CONF / "performance"
    for path in folder.glob("*/*-test.yaml"):
        yield path.relative_to(folder).with_suffix("").as_posix()


def _text(lines: Iterable[str]) -> str:
    return "\n".join(lines).rstrip("\n") + "\n"


if __name__ == "__main__":
    files.write_text(PAGE, with_tables(PAGE.read_text(encoding="utf-8")))
    sys.stdout.write(f"{PAGE.relative_to(ROOT)}\n")
