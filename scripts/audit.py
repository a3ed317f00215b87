"""Compare the pinned versions with known vulnerabilities: a list of ours, and pip-audit if it can.

The list (``scripts/advisories.csv``) holds advisories of packages that we or our dependencies use.
Its column ``checked`` says whether a row was compared with public threads or only written from
memory, at the date in its first line: it is not complete, an entry may be wrong, and it does not
grow by itself. It catches a pin that goes back to a version that we know as vulnerable, also
without a network. pip-audit asks PyPI for all packages; what it could not look up is said, and
never counts as good.

Run: python scripts/audit.py [--offline]
"""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

from packaging.version import Version

_ROOT = Path(__file__).parents[1]
_ADVISORIES = Path(__file__).with_name("advisories.csv")
_PIN = re.compile(r"^([A-Za-z0-9._-]+)(?:\[[^]]*\])?==([^\s;#]+)", re.MULTILINE)


def pins(path: Path) -> dict[str, Version]:
    """Return the pinned versions of a constraints file, by normalised name."""
    found = _PIN.findall(path.read_text(encoding="utf-8"))
    return {re.sub(r"[-_.]+", "-", name).lower(): Version(version) for name, version in found}


def known_problems(pinned: dict[str, Version]) -> tuple[list[str], int, int]:
    """Return a line for each vulnerable pin, how many rows were compared, and how many checked."""
    lines = _ADVISORIES.read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    compared = [row for row in rows if row["package"] in pinned]
    problems = [
        f"{row['package']} {pinned[row['package']]} has {row['advisory']} ({row['what']}); "
        f"repaired in {row['repaired']}"
        for row in compared
        if pinned[row["package"]] < Version(row["repaired"])
    ]
    return problems, len(compared), sum(row["checked"] == "yes" for row in compared)


def ask_pip_audit(path: Path) -> tuple[list[str], str]:
    """Return what pip-audit finds, and a sentence about how much it could look up."""
    requirements = "\n".join(f"{name}=={version}" for name, version in pins(path).items())
    command = ["pip-audit", "--disable-pip", "--no-deps", "-r", "/dev/stdin", "-f", "json"]
    try:
        done = subprocess.run(
            command, input=requirements, capture_output=True, text=True, timeout=600, check=False
        )
        dependencies = json.loads(done.stdout)["dependencies"]
    except (OSError, subprocess.TimeoutExpired, ValueError, KeyError):
        return [], "pip-audit is not installed or got no answer: only the list was compared."
    skipped = sum("skip_reason" in one for one in dependencies)
    problems = [
        f"{one['name']} {one['version']} has {vulnerability['id']}"
        for one in dependencies
        for vulnerability in one.get("vulns", ())
    ]
    return problems, f"pip-audit looked up {len(dependencies) - skipped} of {len(dependencies)}."


def main() -> int:
    """Print the report; 1 if a pin is known as vulnerable."""
    constraints = _ROOT / "constraints.txt"
    problems, n_compared, n_checked = known_problems(pins(constraints))
    told = (
        f"{n_compared} advisories of the list concern pinned packages: {n_checked} were checked "
        f"against public threads, {n_compared - n_checked} only written from memory. The list is "
        "not complete."
    )
    if "--offline" not in sys.argv:
        found, asked = ask_pip_audit(constraints)
        problems, told = problems + found, f"{told} {asked}"
    sys.stdout.write("\n".join([told, *(problems or ["No pin is known as vulnerable."])]) + "\n")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
