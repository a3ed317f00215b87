"""``scilab-rl fit DATA model=a,b``: fit cognitive models to choices and compare them."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.tables import print_json, print_rows, write
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError, MissingDependencyError, did_you_mean
from scilab_rl.run.directory import slug

_log = logging.getLogger(__name__)
FOLDER = "fits"
METHODS = ("map", "mle")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    words, tables = split_words(options.words)
    settings = read_words(words, ("model", "hierarchical", "method", "env", "seed"))
    models = _models(settings)
    method = str(settings.get("method", "map"))
    if method not in METHODS:
        raise ConfigError(f"method must be map or mle, but it is '{method}'.")
    hierarchical = _is_true("hierarchical", settings.get("hierarchical", "false"))
    if options.arviz and not hierarchical:
        raise ConfigError("--arviz writes hierarchical samples; add hierarchical=true.")
    if not tables:
        raise ConfigError("fit requires a table of choices: fit choices.csv model=rescorlawagner.")
    open_project()
    require_jax()
    from scilab_rl.analysis.fitting.panel import make_panel, read_panel
    from scilab_rl.analysis.fitting.report import (
        MODEL_COLUMNS,
        conclusions,
        fit_all,
        group_rows,
        model_rows,
        write_fit,
    )

    panels = [read_panel(Path(table)) for table in tables]
    panel = panels[0]
    if len(panels) > 1:
        panel = make_panel([row for p in panels for own in p.rows for row in own])
    results = fit_all(
        panel,
        models,
        method=method,
        hierarchical=hierarchical,
        env=str(settings.get("env", "")),
        env_kwargs=env_kwargs_of(words),
        seed=whole("seed", settings.get("seed", "0"), 0),
        base=options.base_logdir,
        sampling={"n_warmup": options.warmup, "n_samples": options.samples},
    )
    name = slug(f"{Path(tables[0]).stem}-{'-'.join(models)}")
    folder = options.output or options.base_logdir / FOLDER / name
    title = Path(tables[0]).stem
    page = write_fit(results, folder, title, parquet=options.parquet, arviz=options.arviz)
    if options.json:
        print_json({"models": model_rows(results), "groups": group_rows(results)})
    else:
        optional = ("parameters", "AIC", "converged")
        if_any = ("LOO P", "bad k", "frequency", "PXP")
        print_rows(MODEL_COLUMNS, model_rows(results), optional=optional, if_any=if_any)
        print_rows(("model", "parameter", "group mean", "low", "high"), group_rows(results))
        for line in (*conclusions(results), *results.recovery):
            write(line)
    _log.info("%s", page)
    return 1 if results.problems else 0


def require_jax() -> None:
    """Check that models can be computed.

    Raises:
        MissingDependencyError: If JAX is not installed.
    """
    try:
        import jax  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError("jax", "jax", "for cognitive models") from error


def split_words(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the settings ``KEY=VALUE`` and the other words."""
    settings = [word for word in words if "=" in word]
    return settings, [word for word in words if "=" not in word]


def read_words(words: Sequence[str], allowed: Sequence[str]) -> dict[str, str]:
    """Return settings by key; those of the task, ``env_kwargs.KEY=VALUE``, are left out.

    Raises:
        ConfigError: If a key is unknown or given twice.
    """
    settings: dict[str, str] = {}
    for word in words:
        key, _, value = word.lstrip("+").partition("=")
        if key.startswith("env_kwargs."):
            continue
        if key not in allowed:
            raise ConfigError(
                f"There is no setting '{key}'.{did_you_mean(key, allowed)} Settings: "
                f"{', '.join(allowed)}, env_kwargs.KEY."
            )
        if key in settings:
            raise ConfigError(f"{key} is given twice.")
        settings[key] = value
    return settings


def env_kwargs_of(words: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of the task."""
    import yaml

    found = {}
    for word in words:
        key, _, value = word.lstrip("+").partition("=")
        if key.startswith("env_kwargs."):
            found[key.removeprefix("env_kwargs.")] = yaml.safe_load(value)
    return found


def whole(key: str, text: str, least: int) -> int:
    """Return a whole number of the command line.

    Raises:
        ConfigError: If it is none, or too small.
    """
    if not text.isdigit() or int(text) < least:
        raise ConfigError(f"{key} must be a whole number from {least}, but it is '{text}'.")
    return int(text)


def _models(settings: dict[str, str]) -> list[str]:
    models = [name.strip() for name in settings.get("model", "").strip("[]").split(",")]
    if not all(models):
        raise ConfigError("model=NAME[,NAME...] is missing, for example model=rescorlawagner.")
    if len(set(models)) < len(models):
        raise ConfigError(f"A model is given twice: model={','.join(models)}.")
    return models


def _is_true(key: str, text: str) -> bool:
    if text.lower() not in ("true", "false", "1", "0"):
        raise ConfigError(f"{key} must be true or false, but it is '{text}'.")
    return text.lower() in ("true", "1")


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "fit",
        "Fit cognitive models to choices of people or agents, compare the models, and show what "
        "they would do.",
        base=True,
        json=True,
    )
    add = parser.add_argument
    add(
        "words",
        nargs="+",
        metavar="DATA|KEY=VALUE",
        help="tables with a row per choice (participant_id, response, feedback; block, stage, "
        "state), and model=NAME,NAME... [hierarchical=true] [method=map|mle] [env=TASK] [seed=0]",
    )
    add("--warmup", type=positive, default=500, help="steps of each chain before sampling")
    add("--samples", type=positive, default=1000, help="samples of each of the four chains")
    add("--parquet", action="store_true", help="write the tables as Parquet too")
    add(
        "--arviz",
        action="store_true",
        help="write the samples of each model as MODEL.nc too (hierarchical=true)",
    )
    add("--output", type=Path, metavar="DIR", help="default: data/fits/NAME")
    return parser.parse_args(arguments)
