"""Report which pinned versions have known vulnerabilities, as pip-audit finds them.

A report that never decides: the exit code is always 0. One package is looked up first, so that
without the advisory service the report comes at once. What could not be looked up is counted.

Run: python scripts/audit.py
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

_CONSTRAINTS = Path(__file__).parents[1] / "constraints.txt"
_COMMAND = (
    "-m", "pip_audit", "--disable-pip", "--no-deps", "--requirement", "/dev/stdin",
    "--format", "json", "--progress-spinner", "off", "--timeout", "5",
)  # fmt: skip


def look_up(pins: list[str], seconds: int) -> list[dict[str, Any]]:
    """Return what pip-audit knows about those pins that its advisory service could look up."""
    try:
        done = subprocess.run(
            [sys.executable, *_COMMAND],
            input="\n".join(pins), capture_output=True, text=True, timeout=seconds, check=False,
        )  # fmt: skip
        packages = json.loads(done.stdout)["dependencies"]
    except (OSError, subprocess.TimeoutExpired, ValueError, KeyError):
        return []
    return [package for package in packages if "skip_reason" not in package]


def main() -> None:
    """Print the report."""
    text = _CONSTRAINTS.read_text(encoding="utf-8")
    pins = re.findall(r"^[\w.-]+==[\w.+-]+", text, re.MULTILINE)
    if not look_up(pins[:1], seconds=20):
        print("Nothing was audited: pip-audit is not installed or got no answer.")  # noqa: T201
        return
    known = look_up(pins, seconds=600)
    lines = [f"{len(known)} of {len(pins)} pinned packages were looked up by pip-audit."]
    lines += [
        f"{package['name']} {package['version']} has {vulnerability['id']}"
        for package in known
        for vulnerability in package["vulns"]
    ]
    print("\n".join(lines))  # noqa: T201


if __name__ == "__main__":
    main()
