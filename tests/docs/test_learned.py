"""The tables of what is learned are those of the stored results."""

from __future__ import annotations

import re

from docs import learned

from .pages import ROOT


def test_the_page_is_what_the_command_writes() -> None:
    page = learned.PAGE.read_text(encoding="utf-8")
    assert page == learned.with_tables(page), "run: python -m docs.learned"
    assert page.count("<!-- generated: ") == len(learned.TABLES)


def test_every_task_test_and_agent_is_in_the_table_and_every_link_leads_somewhere() -> None:
    text = "\n".join(learned.best_table())
    results = [*learned.of_agents(), *learned.of_tests()]
    assert [r.task for r in results if f"`{r.task}`" not in text] == []
    assert [r.link for r in results if not r.outcome and r.link not in text] == []
    linked = re.findall(r"\]\(\.\./([^)]+)\)", text)
    assert linked and [path for path in linked if not (ROOT / path).is_file()] == []
    assert "without a stored result" in text


def result(**changes: object) -> learned.Result:
    values = {
        "task": "Task-v0", "algorithm": "sac", "metric": "success", "mean": 0.9, "low": 0.8,
        "high": 1.0, "steps": 1000, "minutes": 2.0, "measured": "3 runs", "outcome": "pass",
        "target": "0.9", "link": "[test](a)",
    }  # fmt: skip
    return learned.Result(**{**values, **changes})  # type: ignore[arg-type]


def test_the_best_result_is_shown_with_the_card_and_what_does_not_pass() -> None:
    failed = result(outcome="fail", mean=0.99, link="[failed](b)")
    undecided = result(outcome="inconclusive", link="[undecided](c)")
    quick = result(mean=0.952, minutes=1.0, link="[quick](d)")
    card = result(outcome="", mean=0.948, link="[card](e)")
    rows = [list(row) for row in learned._rows([failed, undecided, result(), quick, card])]
    assert [row[-1] for row in rows] == ["[quick](d), [card](e)", "[failed](b)", "[undecided](c)"]
    assert [row[-2] for row in rows] == ["pass", "fail", "inconclusive"]
    assert rows[0][2:4] == ["success 0.952", "0.8 to 1"]
