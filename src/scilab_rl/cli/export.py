"""``scilab-rl export RUN``: a table, a data set, a trained agent, or a policy for a robot."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.workspace import PROJECT_AGENTS, open_project
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory, find_policy, find_run, read_episodes

SAVED = ("best", "finished")
_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_project()
    from scilab_rl.analysis.report import write_table

    run = find_run(options.run, options.base_logdir)
    if options.agent:
        return _agent(run, options)
    if options.policy:
        return _policy(run, options)
    if options.minari is not None:
        return _minari(options)
    cfg = load_recorded(run / CONFIG_FILE)
    rows = _training_episodes(run) if options.training else _trials(options)
    origin = {
        "run": run.path.name,
        "env": cfg.env,
        "algorithm": cfg.algorithm.name,
        "run_seed": cfg.seed,
    }
    if rows and "response" in rows[0]:  # a choice task: `scilab-rl fit` reads the table
        origin["participant_id"] = run.path.name
    kind = "training" if options.training else f"trials_{options.per}"
    path = options.output or run.outputs / f"{kind}.{options.format}"
    if path.suffix not in (".csv", ".parquet"):
        raise ConfigError(f"--output must end in .csv or .parquet, but it is '{path}'.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_table([{**origin, **row} for row in rows], path)
    _log.info("%d rows: %s", len(rows), path)
    return 0


def _agent(run: RunDirectory, options: argparse.Namespace) -> int:
    """Write a trained agent and its card."""
    from scilab_rl.acceptance.agents import PAGE_FILE, write_agent

    run.refuse_agent()
    policy = find_policy(run, options.run, options.saved)
    folder = write_agent(
        run,
        policy,
        options.agent,
        options.output or PROJECT_AGENTS,
        n_episodes=options.episodes or 1000,
        license=options.license,
    )
    _log.info("%s\n%s", (folder / PAGE_FILE).read_text(encoding="utf-8"), folder)
    return 0


def _policy(run: RunDirectory, options: argparse.Namespace) -> int:
    """Write a policy for a robot, and say how exactly it acts as the agent."""
    if str(options.policy) in SAVED:
        raise ConfigError(
            f"--policy is the folder to write to; the saved policy is --saved {options.policy}."
        )
    from scilab_rl.deployment.export import write_policy
    from scilab_rl.tracking.console import print_table

    saved = find_policy(run, options.run, options.saved)
    report = write_policy(run, saved, options.policy)
    onnx = report["onnx"]
    print_table(
        [
            ("policy", str(options.policy)),
            ("compared in", f"{report['observations']:,} observations"),
            ("largest difference, NumPy", f"{report['numpy']:.1e}"),
            ("largest difference, ONNX", "not measured" if onnx is None else f"{onnx:.1e}"),
            ("an answer takes", f"{report['milliseconds']:.3f} ms"),
        ]
    )
    return 0


def _minari(options: argparse.Namespace) -> int:
    """Write episodes as a data set for offline learning."""
    from scilab_rl.api.agent import find
    from scilab_rl.api.minari_data import default_id, write_minari

    with find(options.run, options.saved, options.base_logdir) as agent:
        dataset_id = options.minari or default_id(agent)
        folder, summary = write_minari(
            agent, dataset_id, options.episodes or 100, seed=options.seed or None
        )
    _log.info("%s", summary)
    _log.info("minari.load_dataset('%s') reads it: %s", dataset_id, folder)
    return 0


def _trials(options: argparse.Namespace) -> Sequence[Mapping[str, object]]:
    from scilab_rl.api.agent import find

    with find(options.run, options.saved, options.base_logdir) as agent:
        return agent.trajectories(
            options.episodes or 20,
            per=options.per,
            seed=options.seed or None,
            softmax=options.softmax,
            sample=options.sample,
            dimensions=options.dimensions,
        )


def _training_episodes(run: RunDirectory) -> Sequence[Mapping[str, object]]:
    """Return the training episodes, as the run has recorded them."""
    from scilab_rl.training.trajectory_table import fill_silent_outcomes

    rows = read_episodes(run)
    if not rows:
        raise ConfigError(f"The run '{run}' has no training episode yet.")
    fill_silent_outcomes(rows)
    return rows


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "export",
        "Write the observations, actions and metrics of an agent as a tidy table, its episodes as "
        "a data set for offline learning, keep the agent itself under a name, with a card that "
        "says how good it is, or write its policy for a robot.",
        run=True,
        base=True,
    )
    add = parser.add_argument
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--trials", action="store_true", help="new episodes of its policy (the default)"
    )
    what.add_argument("--training", action="store_true", help="the recorded training episodes")
    what.add_argument(
        "--minari",
        nargs="?",
        const="",
        metavar="ID",
        help="new episodes of its policy as a Minari data set; default: ENVIRONMENT/ALGORITHM-v0",
    )
    what.add_argument(
        "--policy",
        type=Path,
        metavar="DIR",
        help="the policy for a robot, as NumPy arrays and ONNX, with a runtime and a contract",
    )
    what.add_argument(
        "--agent",
        metavar="NAME",
        help="keep the policy as agent:NAME, and measure it: agents/NAME/README.md",
    )
    add("--per", choices=("step", "episode"), default="step", help="what a row is; default: a step")
    add(
        "--episodes",
        type=positive,
        help="default: 20; for Minari: 100; of an agent: 1000, over 5 seeds",
    )
    add("--saved", choices=SAVED, default="finished", help="which policy; default: finished")
    add(
        "--softmax",
        type=float,
        metavar="BETA",
        help="choose with probability proportional to exp(BETA Q), as a simulated participant",
    )
    add("--sample", action="store_true", help="draw actions from the policy, not its likeliest one")
    add("--dimensions", type=positive, default=12, help="most numbers of an observation's parts")
    add("--seed", type=int, default=0, help="default: the run's seed plus 1")
    add("--format", choices=("csv", "parquet"), default="csv")
    add("--license", default="MIT", help="of an agent; default: MIT, as Scilab-RL")
    add(
        "--output",
        type=Path,
        metavar="PATH",
        help="the table's file, default: inside the run's folder; the folder of agents, default: "
        "agents",
    )
    return parser.parse_args(arguments)
