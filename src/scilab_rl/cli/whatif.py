"""``scilab-rl whatif RUN --episode E --at T``: other futures of a recorded episode."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import numpy as np

from scilab_rl.api.agent import Agent, find
from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.errors import ConfigError
from scilab_rl.files import shown
from scilab_rl.run.directory import slug
from scilab_rl.run.recordings import chosen_recordings, has_recordings

_log = logging.getLogger(__name__)
_MOST_SEEDS = 200
FOLDER = "whatif"


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    from scilab_rl.analysis.whatif import Change
    from scilab_rl.analysis.whatif_page import verdict
    from scilab_rl.analysis.whatif_report import ask, write_report

    agent = find(options.run, options.checkpoint or "finished", options.base_logdir)
    recording = _recording(agent, options)
    report = ask(
        agent.cfg,
        agent.policy,
        recording,
        Change(options.goal, options.action, options.steps, options.sigma, options.noise),
        scene=None if options.decided else options.at,
        n_futures=options.futures,
        every=options.every,
        question=_question(options),
    )
    page = agent.run.outputs / FOLDER / f"{recording.stem}_{_name(options)}.html"
    write_report(report, page)
    _log.info("%s", verdict(report))
    _log.info("%s", shown(page))
    return 0


def _recording(agent: Agent, options: argparse.Namespace) -> Path:
    """Return the recording that is asked for; record an episode where there is none."""
    is_new = options.seed is not None or options.failed
    if not is_new and (options.episode or has_recordings(agent.run)):
        return chosen_recordings(agent.run, options.episode or "last")[-1]
    if options.checkpoint:  # the episode is that of the run's own policy
        agent = find(options.run, "finished", options.base_logdir)
    with agent:
        seed = agent.unseen_seed if options.seed is None else options.seed
        seed = _failing_seed(agent, seed) if options.failed else seed
        _log.info("Recording an episode with seed %d ...", seed)
        return agent.record(seed=seed).recording


def _failing_seed(agent: Agent, first: int) -> int:
    """Return the first seed whose episode fails."""
    for seed in range(first, first + _MOST_SEEDS):
        success = agent.evaluate(1, seed=seed).success
        if success is not None and success.value == 0:
            return seed
    raise ConfigError(
        f"None of {_MOST_SEEDS} episodes fails (seeds {first} to {first + _MOST_SEEDS - 1}); "
        "--seed N records one that succeeds."
    )


def _question(options: argparse.Namespace) -> str:
    """Return what is asked, as the page's title."""
    parts = []
    if options.goal is not None:
        parts.append(f"the goal were {_numbers_text(options.goal)}")
    if options.action is not None:
        steps = "one step" if options.steps == 1 else f"{options.steps} steps"
        parts.append(f"it did {_numbers_text(options.action)} for {steps}")
    if options.checkpoint:
        parts.append(f"{options.checkpoint} acted")
    if not parts:
        return "when was it decided?" if options.decided else f"what if? From scene {options.at}"
    return f"what if {' and '.join(parts)}?"


def _name(options: argparse.Namespace) -> str:
    parts = ["decided" if options.decided else f"at_{options.at}"]
    parts += [f"goal_{_numbers_text(options.goal)}"] if options.goal is not None else []
    if options.action is not None:
        parts.append(f"action_{_numbers_text(options.action)}_{options.steps}")
    parts += [Path(options.checkpoint).name] if options.checkpoint else []
    parts += [f"noise_{options.noise}"] if options.noise else []
    return slug("_".join(parts))


def _numbers_text(numbers: np.ndarray) -> str:
    return ",".join(f"{number:g}" for number in np.ravel(numbers))


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "whatif", "Put a recorded episode back into a scene and play other futures.", run=True,
        base=True,
    )  # fmt: skip
    add = parser.add_argument
    add(
        "--episode", help="number or name (default: the last one; if there is none, it is recorded)"
    )
    add("--seed", type=int, help="record a new episode with this seed")
    add("--failed", action="store_true", help="record the next episode that fails")
    add("--at", type=int, default=0, metavar="T", help="scene from which on it differs (default 0)")
    add("--decided", action="store_true", help="from every scene: when was the episode decided?")
    add("--every", type=positive, metavar="K", help="with --decided: steps between the scenes")
    add("--goal", type=_numbers, metavar="X,Y,...", help="another desired goal")
    add("--action", type=_numbers, metavar="A,B,...", help="another first action")
    add("--steps", type=positive, default=1, help="for how many steps that action (default 1)")
    add("--checkpoint", help="another policy: best, finished, agent:NAME or a path")
    add("--futures", type=positive, default=20, metavar="N", help="of each scene (default 20)")
    add("--noise", type=int, default=0, metavar="SEED", help="seed of all noise (default 0)")
    add("--sigma", type=float, help="Gaussian noise added to actions, in halves of their range")
    options = parser.parse_args(arguments)
    if options.at < 0:
        parser.error(f"--at: a scene has a number from 0, but it is {options.at}")
    return options


def _numbers(text: str) -> np.ndarray:
    """Convert numbers separated by commas.

    Raises:
        argparse.ArgumentTypeError: If they are none.
    """
    try:
        return np.array([float(part) for part in text.strip("[]").split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"must be numbers separated by commas, but it is '{text}'"
        ) from error
