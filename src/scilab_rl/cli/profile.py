"""``scilab-rl profile KEY=VALUE ...``: train for a little while and show where the time goes."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl import files
from scilab_rl.cli.tables import print_rows, write
from scilab_rl.config.compose import compose, friendly_override
from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.parallel.launchers import read_launcher, refuse_for_single_run
from scilab_rl.run.run import start_run

if TYPE_CHECKING:  # heavy
    from scilab_rl.training.profile import Part

_log = logging.getLogger(__name__)
_N_EPOCHS, _LEAST_STEPS = 2, 500
_USAGE = """usage: scilab-rl profile KEY=VALUE ...

Trains as `scilab-rl KEY=VALUE ...` does, by default for 1,000 steps, or more where an algorithm
learns later, and shows how much of the time each part took. The figures are also in profile.json in
the run's directory."""


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    if {"-h", "--help"} & set(arguments):
        write(_USAGE)
        return 0
    from scilab_rl.training.profile import OTHER, REMEDIES, Profile, Profiling

    profile = Profile()
    overrides = [friendly_override(argument) for argument in arguments]
    given = {override.partition("=")[0] for override in overrides}
    if "n_epochs" not in given:
        overrides.insert(0, f"n_epochs={_N_EPOCHS}")
    open_project()
    cfg = compose(overrides)
    refuse_for_single_run(read_launcher([overrides]))
    if "eval_after_n_steps" not in given:
        cfg = replace(cfg, eval_after_n_steps=_steps_per_epoch(cfg))
        overrides.insert(0, f"eval_after_n_steps={cfg.eval_after_n_steps}")
    result = start_run(cfg, overrides, [Profiling(profile)])
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


def _steps_per_epoch(cfg: RunConfig) -> int:
    """Return enough that the first of two epochs ends about when the algorithm begins to learn."""
    arguments = cfg.algorithm.arguments
    rollout = arguments.get("n_steps", 0) * cfg.n_envs
    return max(_LEAST_STEPS, cfg.n_envs, int(arguments.get("learning_starts", rollout)))


def _row(name: str, part: Part, total: float) -> dict[str, object]:
    return {
        "part": name,
        "seconds": part.seconds,
        "share": f"{part.seconds / total:.1%}",
        "calls": part.n_calls,
        "ms per call": 1000 * part.seconds / max(part.n_calls, 1),
    }
