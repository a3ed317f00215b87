"""``scilab-rl probe RUN --metrics ...``: compute metrics for recorded episodes."""

from __future__ import annotations

import argparse
import logging

from scilab_rl.cli.parser import CommandParser
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.workspace import open_project
from scilab_rl.files import shown
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory, find_policy, find_run
from scilab_rl.run.provenance import fingerprint_differences
from scilab_rl.run.recordings import chosen_recordings

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_project()
    from scilab_rl.learning.inspector import AgentInspector
    from scilab_rl.recording.recompute_metrics import recompute_metrics
    from scilab_rl.recording.recorder import render_clip_files
    from scilab_rl.recording.records import SUFFIX, load_clip, save_clip
    from scilab_rl.run.player import load_player

    run = find_run(options.run, options.base_logdir)
    cfg = load_recorded(run / CONFIG_FILE)
    recordings = chosen_recordings(run, options.episode)
    if options.checkpoint:
        policies = [find_policy(run, name) for name in options.checkpoint]
    else:
        policies = [find_policy(run, "finished", "best")]
    for line in fingerprint_differences([run, *(RunDirectory(path.parent) for path in policies)]):
        _log.warning(line)
    inspectors = {}
    for policy in policies:
        env, model = load_player(cfg, policy, record=False)
        env.close()
        inspectors[policy.name.removeprefix("rl_model_")] = AgentInspector(model)
    for path in recordings:
        clip = recompute_metrics(load_clip(path), inspectors, options.metrics, cfg.algorithm.name)
        probed = path.with_name(f"{clip.info.name}{SUFFIX}")
        save_clip(clip, probed)
        try:
            render_clip_files(probed)
        except RuntimeError as error:
            _log.warning("%s: %s", probed.name, error)
        _log.info("%s", shown(probed.with_suffix(".html")))
    return 0


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "probe",
        "Compute metrics for recorded episodes and add their curves.",
        run=True,
        base=True,
    )
    parser.add_argument("--metrics", required=True, type=_names, help="q_value,critic_variance,...")
    parser.add_argument(
        "--checkpoint",
        type=_names,
        default=[],
        help="policies to evaluate: best,finished, or paths (default: finished)",
    )
    parser.add_argument("--episode", default="all", help="number or name (default: all)")
    return parser.parse_args(arguments)


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.strip("[]").split(",") if name.strip()]
