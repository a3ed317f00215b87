"""Where a run comes from: command, code, versions, machine, and the environment's fingerprint."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from importlib import metadata
from typing import Any

from scilab_rl import files
from scilab_rl.results import RunDirectory

_DIFF_LIMIT_BYTES = 1_000_000


def write(directory: RunDirectory, overrides: Sequence[str], env: Any) -> None:
    """Write ``provenance.json`` and, for changed code, ``git.diff``.

    Args:
        directory: The run's directory.
        overrides: What the user typed.
        env: A single environment, for the fingerprint; it is reset and stepped.
    """
    from scilab_rl.envs.fingerprint import fingerprint

    diff = _git("diff", "HEAD")
    if diff:
        files.write_text(directory / "git.diff", diff[:_DIFF_LIMIT_BYTES])
    files.write_json(
        directory / "provenance.json",
        {
            "command": shlex.join(sys.argv),
            "overrides": list(overrides),
            "git_commit": _git("rev-parse", "HEAD").strip() or None,
            "git_changed": bool(diff),
            "fingerprint": fingerprint(env),
            "python": platform.python_version(),
            "platform": platform.platform(),
            "versions": {d.name: d.version for d in sorted(metadata.distributions(), key=_name)},
        },
    )


def _name(distribution: metadata.Distribution) -> str:
    return distribution.name.lower()


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(
            ["git", *arguments],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=20,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout if done.returncode == 0 else ""
