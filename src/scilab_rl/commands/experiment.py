"""``scilab-rl experiment base=A variant=B env=E seeds=N``: train what is missing, then compare."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence

from scilab_rl.commands import compare
from scilab_rl.commands.parser import CommandParser, positive
from scilab_rl.errors import ConfigError, SomeRunsFailedError
from scilab_rl.results import slug
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)
_LOCAL = {"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"}
_BASE, _VARIANT, _SEEDS = "base", "variant", "seeds"


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code: 3 when some runs have failed."""
    options, words = _parse(arguments)
    sides, fixed, n_seeds = read_words(words)
    open_desk()
    import hydra

    from scilab_rl.performance.experiments import plan, train_missing

    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        planned = plan(sides, fixed, n_seeds, options.first_seed, options.base_logdir)
    for side in planned:
        _log.info("%s: %d of %d runs are there.", side.label, n_seeds - len(side.missing), n_seeds)
    folder = options.base_logdir / "experiments" / slug("-vs-".join(s.label for s in planned))
    failures = train_missing(planned, _LOCAL, options.jobs, folder)
    compare.show([side.group(options.base_logdir) for side in planned], options)
    if failures:
        raise SomeRunsFailedError(f"{len(failures)} runs failed, first with: {failures[0]}")
    return 0


def read_words(words: Sequence[str]) -> tuple[dict[str, list[str]], list[str], int]:
    """Divide the command line into sides, shared overrides and the number of seeds.

    ``variant=sac_var`` names an algorithm; ``variant=sac_var,algorithm.gamma=0.9`` changes it, and
    ``variant="higher gamma:sac,algorithm.gamma=0.99"`` gives it a name. There may be several.

    Returns:
        Label to overrides for each side, the shared overrides, and the number of seeds.

    Raises:
        ConfigError: If a side is missing or given twice.
    """
    sides: dict[str, list[str]] = {}
    fixed, n_seeds = [], 5
    for word in words:
        key, _, value = word.partition("=")
        if key in (_BASE, _VARIANT):
            label, overrides = _read_side(value)
            if label in sides:
                raise ConfigError(f"There are two sides '{label}'; name one: {key}=NAME:{value}.")
            sides = {label: overrides, **sides} if key == _BASE else {**sides, label: overrides}
        elif key == _SEEDS:
            n_seeds = positive(value)
        else:
            fixed.append(word)
    n_bases = sum(word.startswith(f"{_BASE}=") for word in words)
    if n_bases != 1 or len(sides) < 2:
        raise ConfigError(
            "experiment needs one base and at least one variant, for example: "
            "base=sac variant=sac_var env=FetchPush-v4 seeds=10"
        )
    return sides, fixed, n_seeds


def _read_side(value: str) -> tuple[str, list[str]]:
    label, separator, described = value.partition(":")
    described = described if separator else value
    algorithm, *changes = described.split(",")
    name = label if separator else ",".join([algorithm, *(c.rpartition(".")[2] for c in changes)])
    return name, [f"algorithm={algorithm}", *changes]


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    parser = CommandParser("experiment", "Train what is missing of a comparison, then compare.")
    parser.add_argument(
        "words",
        nargs="+",
        metavar="KEY=VALUE",
        help="base=A variant=B [variant=C] seeds=N, and overrides for all runs, such as env=E",
    )
    parser.add_argument("--first-seed", type=positive, default=1, help="default: 1")
    parser.add_argument("--jobs", type=positive, metavar="N", help="runs at a time")
    compare.add_options(parser)
    options = parser.parse_args(arguments)
    return options, options.words
