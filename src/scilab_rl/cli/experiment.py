"""``scilab-rl experiment base=A variant=B env=E seeds=N``: train missing runs, then compare."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence

from scilab_rl.cli import compare
from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError, SomeRunsFailedError
from scilab_rl.run.directory import slug

_log = logging.getLogger(__name__)
_BASE, _VARIANT, _SEEDS = "base", "variant", "seeds"


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code: 3 when some runs have failed."""
    options, words = _parse(arguments)
    groups, fixed, n_seeds = read_words(words)
    open_project()
    from scilab_rl.analysis.experiments import plan, power_of, train_missing
    from scilab_rl.parallel.launchers import read_launcher

    launcher = read_launcher([*words, *fixed] for words in groups.values())
    planned = plan(groups, fixed, n_seeds, options.first_seed, options.base_logdir)
    _log.info("%s", power_of(n_seeds, len(planned)))
    if not any(group.stops_early for group in planned):
        _log.info("All runs train to their last epoch, so that they can be compared fairly.")
    for group in planned:
        _log.info(
            "%s: %d of %d runs exist; training %d.",
            group.label,
            n_seeds - len(group.missing),
            n_seeds,
            len(group.missing),
        )
    folder = options.base_logdir / "experiments" / slug("-vs-".join(s.label for s in planned))
    failures = train_missing(planned, launcher, options.jobs, folder)
    compare.show([group.group(options.base_logdir) for group in planned], options)
    if failures:
        raise SomeRunsFailedError(f"{len(failures)} runs failed, first with: {failures[0]}")
    return 0


def read_words(words: Sequence[str]) -> tuple[dict[str, list[str]], list[str], int]:
    """Split the command line into groups, shared overrides and the number of seeds.

    ``variant=sac_var`` names an algorithm; ``variant=sac_var,algorithm.gamma=0.9`` changes it, and
    ``variant="higher gamma:sac,algorithm.gamma=0.99"`` gives it a name. There may be several.

    Returns:
        Label to overrides for each group, the shared overrides, and the number of seeds.

    Raises:
        ConfigError: If a group is missing or given twice.
    """
    groups: dict[str, list[str]] = {}
    fixed, n_seeds = [], 5
    for word in words:
        key, _, value = word.partition("=")
        if key in (_BASE, _VARIANT):
            label, overrides = _read_group(value)
            if label in groups:
                raise ConfigError(f"There are two groups '{label}'; name one: {key}=NAME:{value}.")
            groups = {label: overrides, **groups} if key == _BASE else {**groups, label: overrides}
        elif key == _SEEDS:
            n_seeds = positive(value)
        else:
            fixed.append(word)
    n_bases = sum(word.startswith(f"{_BASE}=") for word in words)
    if n_bases != 1 or len(groups) < 2:
        raise ConfigError(
            "experiment requires one base and at least one variant, for example: "
            "base=sac variant=sac_var env=FetchPush-v4 seeds=10"
        )
    return groups, fixed, n_seeds


def _read_group(value: str) -> tuple[str, list[str]]:
    label, separator, described = value.partition(":")
    described = described if separator else value
    algorithm, *changes = described.split(",")
    name = label if separator else ",".join([algorithm, *(c.rpartition(".")[2] for c in changes)])
    return name, [f"algorithm={algorithm}", *changes]


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    parser = CommandParser(
        "experiment", "Train the missing runs of a comparison, then compare.", base=True, json=True
    )
    parser.add_argument(
        "words",
        nargs="+",
        metavar="KEY=VALUE",
        help="base=A variant=B [variant=C] seeds=N, and overrides for all runs, such as env=E",
    )
    parser.add_argument("--first-seed", type=positive, default=1, help="default: 1")
    parser.add_argument("--jobs", type=positive, metavar="N", help="parallel runs")
    compare.add_options(parser)
    options = parser.parse_args(arguments)
    return options, options.words
