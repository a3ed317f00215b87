"""``scilab-rl goals RUN``: where in the space of its goals does an agent fail?"""

from __future__ import annotations

import argparse
import logging

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.tables import write

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    from scilab_rl.api.agent import find
    from scilab_rl.api.goals import goals

    summary = goals(
        find(options.run, options.policy, options.base_logdir),
        cells=options.cells,
        episodes=options.episodes,
        axes=options.axes,
        seed=options.seed,
        checkpoints=options.checkpoint,
        record=options.record,
        progress=_tell,
    )
    write(str(summary))
    _log.info("%s", summary.path)
    return 0


def _tell(done: int, n: int) -> None:
    if done % max(1, n // 5) == 0 and n >= 100:
        _log.info("%d of %d episodes", done, n)


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "goals",
        "Map where in the space of its goals an agent succeeds, what it expects, and what it was "
        "asked for.",
        run=True,
        base=True,
    )
    add = parser.add_argument
    add("--episodes", type=positive, default=4, help="of each goal (default 4)")
    add("--cells", type=_numbers, metavar="N,M", help="goals on each axis (default 15,15)")
    add("--axes", type=_numbers, metavar="I,J", help="dimensions of the goal (default: the free)")
    add("--policy", default="best", help="best (the default), finished or a path")
    add(
        "--checkpoint",
        type=lambda text: text.split(","),
        default=[],
        help="policies whose values are compared: all, or names",
    )
    add("--record", type=int, default=3, metavar="N", help="record N failed episodes (default 3)")
    add("--seed", type=positive, default=1, help="of all chance (default 1)")
    return parser.parse_args(arguments)


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be whole numbers such as 15,15, but it is '{text}'"
        ) from None
