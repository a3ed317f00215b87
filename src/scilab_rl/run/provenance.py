"""Where a run comes from: command, code, versions, machine, and the environment's fingerprint."""

from __future__ import annotations

import json
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from typing import TYPE_CHECKING

from scilab_rl import files, machine
from scilab_rl.config.schema import ALIASES, Values
from scilab_rl.errors import ConfigError
from scilab_rl.redaction import redact
from scilab_rl.run.directory import RunDirectory

if TYPE_CHECKING:  # heavy
    import gymnasium as gym

PROVENANCE_FILE = "provenance.json"
_DIFF_LIMIT_BYTES = 1_000_000
# What makes an environment: only runs that agree here are expected to agree in the fingerprint.
_ENVIRONMENT_KEYS = ("env", "env_kwargs", "wrappers", *ALIASES)
# The packages that usually are the reason, by the names that they are installed under.
_SIMULATION = ("mujoco", "gymnasium", "gymnasium-robotics", "metaworld", "highway-env", "MyoSuite")


def write(directory: RunDirectory, overrides: Sequence[str], env: gym.Env) -> None:
    """Write ``provenance.json`` and, for changed code, ``git.diff``, both without secrets.

    Args:
        directory: The run's directory.
        overrides: What the user typed.
        env: A single environment, for the fingerprint; it is reset and stepped.
    """
    diff = _git("diff", "HEAD")
    if diff:
        files.write_text(directory / "git.diff", redact(diff)[:_DIFF_LIMIT_BYTES])
    files.write_json(
        directory / PROVENANCE_FILE,
        {
            "command": redact(shlex.join(sys.argv)),
            "overrides": [redact(override) for override in overrides],
            "git_commit": _git("rev-parse", "HEAD").strip() or None,
            "git_changed": bool(diff),
            "fingerprint": fingerprint_of(env),
            "python": platform.python_version(),
            "platform": platform.platform(),
            "machine": machine.describe() | _gpu(),
            "versions": {d.name: d.version for d in sorted(metadata.distributions(), key=_name)},
        },
    )


def fingerprint_of(env: gym.Env) -> str | None:
    """Return the fingerprint; None for an environment that fails, which training will tell."""
    from scilab_rl.envs.fingerprint import fingerprint

    try:
        return fingerprint(env)
    except Exception:  # noqa: BLE001 - any environment may fail in its own way
        return None


def recorded_fingerprint(run: RunDirectory) -> str | None:
    """Return the fingerprint that a run or a trained agent has recorded, if it has."""
    for name in (PROVENANCE_FILE, "card.json"):
        try:
            return json.loads((run / name).read_text(encoding="utf-8"))["fingerprint"]
        except (OSError, ValueError, TypeError, KeyError):
            continue
    return None


def fingerprint_differences(runs: Iterable[RunDirectory]) -> list[str]:
    """Return which environments differ between runs that are compared.

    Runs count as of the same environment when its id, arguments and wrappers are equal. Runs whose
    files cannot be read are left out.

    Args:
        runs: The runs to compare.

    Returns:
        One line for each environment with more than one fingerprint; none when all is well.
    """
    groups: dict[str, dict[str, list[Values]]] = {}
    for run in runs:
        described = _described_environment(run)
        if described is not None:
            environment, source = described
            fingerprints = groups.setdefault(environment, {})
            fingerprints.setdefault(source["fingerprint"], []).append(source)
    return [
        _difference(json.loads(environment)["env"], sources)
        for environment, sources in groups.items()
        if len(sources) > 1
    ]


def _described_environment(run: RunDirectory) -> tuple[str, Values] | None:
    """Return the keys of the run's environment as JSON, and the run's provenance."""
    try:
        source = json.loads((run / PROVENANCE_FILE).read_text(encoding="utf-8"))
        config = run.read_config()
        described = {key: config[key] for key in _ENVIRONMENT_KEYS if config.get(key)}
        return (json.dumps(described, sort_keys=True), source) if source["fingerprint"] else None
    except (OSError, ConfigError, ValueError, TypeError, KeyError):
        return None


def _difference(env_id: str, sources: Mapping[str, Sequence[Values]]) -> str:
    """Return the line about one environment; the most frequent fingerprint comes first."""
    frequent = sorted(sources.items(), key=lambda item: -len(item[1]))
    counts = ", ".join(f"{name} ({len(of_it)})" for name, of_it in frequent)
    every = [source for of_it in sources.values() for source in of_it]
    versions = {
        package: sorted({str(source.get("versions", {}).get(package)) for source in every})
        for package in _SIMULATION
    }
    reasons = [f"{name} {' / '.join(found)}" for name, found in versions.items() if len(found) > 1]
    because = f" Versions differ: {', '.join(reasons)}." if reasons else ""
    return (
        f"{env_id} did not behave the same in these runs, so their results do not compare: its "
        f"fingerprints (runs) are {counts}.{because}"
    )


def _gpu() -> dict[str, str]:
    """Return the name of the GPU that PyTorch or JAX would use, if there is one."""
    import torch

    if torch.cuda.is_available():
        return {"gpu": torch.cuda.get_device_name()}
    jax = sys.modules.get("jax")  # only algorithms that are compiled by JAX import it
    if jax is not None and jax.default_backend() != "cpu":
        return {"gpu": jax.devices()[0].device_kind}
    return {}


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
