"""``scilab-rl probe RUN --metrics ...``: put new questions to recorded episodes."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.view import chosen_recordings
from scilab_rl.config import load_recorded
from scilab_rl.errors import ConfigError
from scilab_rl.provenance import fingerprint_differences
from scilab_rl.results import CONFIG_FILE, RunDirectory, find_run
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)
_POLICY = "rl_model_"


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_desk()
    from scilab_rl.training.reprobing import reprobe
    from scilab_rl.visualization.archive import SUFFIX, load_clip, save_clip
    from scilab_rl.visualization.develop import develop

    run = find_run(options.run, options.base_logdir)
    cfg = load_recorded(run / CONFIG_FILE)
    recordings = chosen_recordings(run, options.episode)
    asked = [RunDirectory(_policy_folder(run, name).parent) for name in options.checkpoint]
    for line in fingerprint_differences([run, *asked]):
        _log.warning(line)
    minds = _minds(cfg, run, options.checkpoint)
    for path in recordings:
        clip = reprobe(load_clip(path), minds, options.metrics, cfg.algorithm.name)
        probed = path.with_name(f"{clip.info.name}{SUFFIX}")
        save_clip(clip, probed)
        try:
            develop(probed)
        except RuntimeError as error:
            _log.warning("%s: %s", probed.name, error)
        _log.info("%s", probed.with_suffix(".html"))
    return 0


def _minds(cfg: Any, run: RunDirectory, names: list[str]) -> dict[str, Any]:
    """Load the networks to ask, by their labels."""
    from scilab_rl.algorithms.inspection import Inspection
    from scilab_rl.commands.play import load_player

    minds = {}
    for name in names or [_newest_policy(run)]:
        env, model = load_player(cfg.copy(), _policy_folder(run, name), record=False)
        env.close()
        minds[Path(name).name.removeprefix(_POLICY)] = Inspection(model)
    return minds


def _policy_folder(run: RunDirectory, name: str) -> Path:
    for folder in (run / f"{_POLICY}{name}", run / name, Path(name)):
        if (folder / "manifest.json").is_file():
            return folder
    raise ConfigError(f"There is no policy '{name}'. The run has: {', '.join(_policies(run))}.")


def _policies(run: RunDirectory) -> list[str]:
    return sorted(
        path.parent.name.removeprefix(_POLICY) for path in run.path.glob("*/manifest.json")
    )


def _newest_policy(run: RunDirectory) -> str:
    known = _policies(run)
    for name in ("finished", "best", *known):
        if name in known:
            return name
    raise ConfigError(f"The run '{run}' has not saved a policy yet: it needs one epoch.")


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser("probe", "Compute metrics for recorded episodes and add their curves.")
    parser.add_argument("run", help="'last', the path of a run, or a part of its name")
    parser.add_argument("--metrics", required=True, type=_names, help="q_value,critic_variance,...")
    parser.add_argument(
        "--checkpoint",
        type=_names,
        default=[],
        help="policies to ask: best,finished, or paths (default: finished)",
    )
    parser.add_argument("--episode", default="all", help="number or name (default: all)")
    parser.add_argument("--base-logdir", type=Path, default=Path("data"))
    return parser.parse_args(arguments)


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.strip("[]").split(",") if name.strip()]
