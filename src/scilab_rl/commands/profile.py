"""``scilab-rl profile KEY=VALUE ...``: train for a little while and show where the time goes."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import Any

import hydra

from scilab_rl import config, experiment, files
from scilab_rl.commands.tables import print_rows, write
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)
_SHORT = {"n_epochs": "2", "eval_after_n_steps": "500"}
_USAGE = """usage: scilab-rl profile KEY=VALUE ...

Trains as `scilab-rl KEY=VALUE ...` does, by default for 1,000 steps, and shows how much of the time
each part took. The figures are also in profile.json in the run's directory."""


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    if {"-h", "--help"} & set(arguments):
        write(_USAGE)
        return 0
    from scilab_rl.training.profile import OTHER, REMEDIES, Profile, attach

    profiles: list[Profile] = []
    overrides = [config.friendly_override(argument) for argument in arguments]
    given = {override.partition("=")[0] for override in overrides}
    overrides = [f"{key}={n}" for key, n in _SHORT.items() if key not in given] + overrides
    open_desk()
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        cfg = config.compose(overrides)
    result = experiment.run(cfg, overrides, watch=lambda s: profiles.append(attach(s)))
    (profile,) = profiles
    profile.stop()
    parts = sorted(profile.parts.items(), key=lambda item: -item[1].seconds)
    print_rows(
        ["part", "seconds", "share", "calls", "ms per call"],
        [_row(name, part, profile.seconds) for name, part in parts],
    )
    costs = {name: asdict(part) for name, part in parts}
    figures = {"seconds": profile.seconds, "steps": result.steps, "parts": costs}
    files.write_json(Path(result.run_dir) / "profile.json", figures)
    largest = next(name for name, _ in parts if name != OTHER)
    _log.info("%d steps in %.1f s.", result.steps, profile.seconds)
    _log.info("Most goes to %s: %s.", largest, REMEDIES.get(largest, "nothing to gain"))
    return result.exit_code


def _row(name: str, part: Any, total: float) -> dict[str, Any]:
    return {
        "part": name,
        "seconds": part.seconds,
        "share": f"{part.seconds / total:.1%}",
        "calls": part.n_calls,
        "ms per call": 1000 * part.seconds / max(part.n_calls, 1),
    }
