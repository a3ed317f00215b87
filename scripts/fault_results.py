"""Write results of the fault tests into the table of docs/reliability.md, row by row.

    pytest -k "test_f0 or test_f1 or test_f2 or test_f3 or test_f4" -m "slow or not slow" \
        --junitxml=faults.xml
    python scripts/fault_results.py faults.xml

Of a test that is in several files the last result counts.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

DOCUMENT = Path(__file__).parents[1] / "docs" / "reliability.md"
_ROW = re.compile(r"^(\| (F\d\d) \| P\d \| .* \| )[^|]*( \| [^|]* \|)$", re.MULTILINE)
_OUTCOMES = {"failure": "failed", "error": "failed", "skipped": "skipped"}


def main() -> None:
    """Read the files and rewrite the column."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("results", type=Path, nargs="+", help="what --junitxml wrote")
    rows = outcomes_by_row(parser.parse_args().results)
    text = DOCUMENT.read_text(encoding="utf-8")
    text = _ROW.sub(lambda row: f"{row[1]}{in_words(rows.get(row[2], Counter()))}{row[3]}", text)
    DOCUMENT.write_text(text, encoding="utf-8")


def outcomes_by_row(files: list[Path]) -> dict[str, Counter[str]]:
    """Return how many tests of each row have passed, failed, or were skipped."""
    outcomes: dict[tuple[str, str], str] = {}
    for file in files:
        for case in ElementTree.parse(file).iter("testcase"):
            said = [_OUTCOMES[child.tag] for child in case if child.tag in _OUTCOMES]
            outcomes[case.attrib["classname"], case.attrib["name"]] = said[0] if said else "passed"
    rows: dict[str, Counter[str]] = {}
    for (_, name), outcome in outcomes.items():
        if found := re.match(r"test_(f\d\d)_", name):
            rows.setdefault(found[1].upper(), Counter())[outcome] += 1
    return rows


def in_words(outcomes: Counter[str]) -> str:
    """Return for example ``12 passed, 1 skipped``."""
    return ", ".join(f"{n} {outcome}" for outcome, n in sorted(outcomes.items())) or "not run"


if __name__ == "__main__":
    main()
