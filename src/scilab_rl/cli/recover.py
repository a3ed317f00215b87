"""``scilab-rl recover model=a,b env=TASK``: can this design tell parameters and models apart?"""

from __future__ import annotations

import logging

from scilab_rl.cli.fit import env_kwargs_of, read_words, require_jax, split_words, whole
from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import print_json, print_rows
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError

_log = logging.getLogger(__name__)
_KEYS = ("model", "env", "n_participants", "n_trials", "seed")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "recover",
        "Simulate participants with known parameters, fit all models to all of them, and compare "
        "with the truth.",
        base=True,
        json=True,
    )
    parser.add_argument(
        "words",
        nargs="+",
        metavar="KEY=VALUE",
        help="model=NAME[,NAME...] env=TASK [n_participants=100] [n_trials=200] [seed=0] "
        "[env_kwargs.KEY=VALUE]",
    )
    options = parser.parse_args(arguments)
    words, others = split_words(options.words)
    settings = read_words(words, _KEYS)
    models = [name.strip() for name in settings.get("model", "").strip("[]").split(",") if name]
    if not models or "env" not in settings or others:
        raise ConfigError(
            "recover requires model=NAME[,NAME...] and env=TASK, for example: recover "
            "model=rescorlawagner,randomchoice env=Bandit-drifting-a2."
        )
    open_project()
    require_jax()
    from scilab_rl.analysis.fitting.recovery import recover
    from scilab_rl.analysis.fitting.report import RECOVERY_COLUMNS, write_recovery

    result = recover(
        models,
        settings["env"],
        n_participants=whole("n_participants", settings.get("n_participants", "100"), 2),
        n_trials=whole("n_trials", settings.get("n_trials", "200"), 1),
        env_kwargs=env_kwargs_of(words),
        seed=whole("seed", settings.get("seed", "0"), 0),
    )
    page = write_recovery(result, options.base_logdir)
    if options.json:
        print_json({"parameters": result.rows(), "confusion": result.confusion_rows()})
    else:
        print_rows(RECOVERY_COLUMNS, result.rows(), optional=("RMSE", "r, real scale"))
        print_rows(("simulated", *result.models), result.confusion_rows())
    _log.info("%s", page)
    return 0
