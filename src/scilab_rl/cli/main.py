"""The command line: ``scilab-rl KEY=VALUE ...`` trains, ``scilab-rl COMMAND ...`` runs commands."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scilab_rl import __version__, telemetry
from scilab_rl.errors import ConfigError, ScilabRLError, SomeRunsFailedError, did_you_mean
from scilab_rl.redaction import RedactingFormatter, redact

COMMANDS = {
    "play": "watch or record a trained policy and measure its success",
    "view": "look at recorded episodes",
    "probe": "compute metrics for recorded episodes, also with other checkpoints",
    "whatif": "play other futures of a recorded episode: when was it decided?",
    "resume": "continue an interrupted run",
    "new": "create an algorithm of your own from an existing one",
    "runs": "list the recorded runs",
    "board": "all runs and studies on one page, in a browser",
    "plot": "draw the learning curves of runs, here or as a picture",
    "note": "write a note to a run",
    "tag": "give a run tags, by which it is found again",
    "delete": "remove runs, after a question",
    "profile": "train for a little while and show where the time goes",
    "study": "show the results of a hyperparameter study",
    "compare": "compare algorithms, groups or runs: which learns better",
    "experiment": "train the missing runs of a comparison, then compare",
    "performance": "test whether everything still learns as well as before",
    "goals": "map where in its goal space an agent fails, and what it expects",
    "human": "let a person play a task in a browser, and keep each choice",
    "fit": "fit cognitive models to choices and compare them",
    "recover": "simulate and fit: can parameters and models be identified?",
    "export": "write observations, actions and metrics of an agent as a table",
    "dataset": "write expert, medium, scripted and random data sets of a task",
    "mlflow": "browse the learning curves of all runs with MLflow",
    "sync": "send runs to a tracker that was unavailable while they trained",
    "algorithms": "list the algorithms",
    "envs": "list the environments",
    "explain": "show which file or layer sets the value of a key",
    "completion": "let the Tab key complete commands, keys and runs",
    "clean": "remove what killed processes left behind",
    "doctor": "check the installation and how to repair it",
}
EXIT_INTERRUPTED, EXIT_PIPE_CLOSED = 130, 141
# Hydra's flags; it would print its usage for any other.
_HYDRA_FLAGS = (
    "--help", "-h", "--hydra-help", "--cfg", "-c", "--resolve", "--package", "-p", "--run", "-r",
    "--multirun", "-m", "--shell-completion", "-sc", "--config-path", "-cp", "--config-name",
    "-cn", "--config-dir", "-cd", "--experimental-rerun", "--info", "-i",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    _fill_closed_streams()
    sys.exit(run_command_line(list(sys.argv[1:] if arguments is None else arguments)))


def run_command_line(arguments: list[str]) -> int:
    """Run one command and return its exit code.

    0: done. 1: the run failed. 2: wrong input, nothing started. 3: some of several runs failed.
    130: interrupted.
    """
    debug = "--debug" in arguments
    trusts_pickle = "--trust-pickle" in arguments
    flags = ("--debug", "--trust-pickle")
    arguments = [argument for argument in arguments if argument not in flags]
    _set_up_messages(debug)
    telemetry.switch_off()
    os.environ["SCILAB_RL_TRUST_PICKLE"] = str(int(trusts_pickle))  # see `training.sb3_archives`
    try:
        return _dispatch(_without_trusted_modules(arguments))
    except ScilabRLError as error:
        if debug:
            traceback.print_exc()
        sys.stderr.write(f"error: {_one_line(error)}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader closed the pipe, as in `scilab-rl runs | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_PIPE_CLOSED
    except Exception as error:
        if debug:
            raise
        sys.stderr.write(
            f"error: {type(error).__name__}: {_one_line(error)} (unexpected; --debug shows the "
            "traceback)\n"
        )
        return 1


def _without_trusted_modules(arguments: Sequence[str]) -> list[str]:
    """Take out ``--trust-module=NAME``, which `trust` reads from the environment."""
    flag = "--trust-module"
    if flag in arguments:
        raise ConfigError(f"{flag} requires the name of a module: {flag}=my_package.envs.")
    named = [a.partition("=")[2] for a in arguments if a.startswith(f"{flag}=")]
    os.environ["SCILAB_RL_TRUST_MODULES"] = ",".join(named)
    return [a for a in arguments if not a.startswith(f"{flag}=")]


def _fill_closed_streams() -> None:
    """Open the null device for standard streams that are closed.

    Otherwise the first opened files would get their descriptors, and all printed text.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open("w")
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")


def _one_line(error: Exception) -> str:
    """Return an error's message without secrets and control characters."""
    line = redact(" ".join(str(error).split()))
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def _dispatch(arguments: list[str]) -> int:
    first = arguments[0] if arguments else ""
    if "--version" in arguments:
        sys.stdout.write(f"scilab-rl {__version__}\n")
        return 0
    if first in COMMANDS:
        module = importlib.import_module(f"scilab_rl.cli.{first}")
        return int(module.main(arguments[1:]) or 0)
    if first in ("-h", "--help"):
        from scilab_rl.cli.help import print_help, print_short_help

        if arguments[1:2] == ["all"]:
            print_help(COMMANDS)
        else:
            print_short_help(COMMANDS)
        return 0
    if first and not first.startswith(("-", "~")) and "=" not in first and first != "train":
        if first.lstrip("+") in config_keys():
            raise ConfigError(f"{first} requires a value: {first}=VALUE.")
        raise ConfigError(
            f"There is no command '{first}'.{did_you_mean(first, COMMANDS)} "
            f"Commands: {', '.join(COMMANDS)}. To train, give KEY=VALUE, for example env=FetchPush."
        )
    arguments = _with_host_as_key(arguments[1:] if first == "train" else arguments)
    _refuse_unknown_flags(arguments)
    return train(arguments)


def _refuse_unknown_flags(arguments: Sequence[str]) -> None:
    for argument in arguments:
        flag = argument.partition("=")[0]
        if flag.startswith("-") and flag not in _HYDRA_FLAGS:
            words = [*_HYDRA_FLAGS, *config_keys()]
            raise ConfigError(
                f"There is no flag '{flag}'.{did_you_mean(flag.lstrip('-'), words)} Keys are given "
                "without dashes, as in n_epochs=3; `scilab-rl --help all` lists keys and flags."
            )
    _refuse_bad_values_of_flags(arguments)


def _refuse_bad_values_of_flags(arguments: Sequence[str]) -> None:
    """Check Hydra's flags with its own parser, without its usage text."""
    import argparse

    from hydra._internal.utils import get_args_parser

    parser: argparse.ArgumentParser = get_args_parser()
    parser.exit_on_error = False
    try:
        parser.parse_known_args(list(arguments))
    except argparse.ArgumentError as error:
        raise ConfigError(f"{error}.") from error


def _with_host_as_key(arguments: list[str]) -> list[str]:
    """Turn ``--host ADDRESS`` into the key ``viewer_host``."""
    if "--host" not in arguments:
        return arguments
    index = arguments.index("--host")
    if index + 1 == len(arguments):
        raise ConfigError("--host requires an address, for example --host 0.0.0.0.")
    return [*arguments[:index], f"viewer_host={arguments[index + 1]}", *arguments[index + 2 :]]


def config_keys() -> list[str]:
    """Return the keys of the configuration."""
    from scilab_rl.config.schema import ALIASES, GROUPS, KEYS

    return [*(key.name for key in KEYS), *GROUPS, *ALIASES]


def train(arguments: list[str]) -> int:
    """Train: Hydra composes the configuration of one run, or of each run of a multirun."""
    # Hydra must raise errors, not print its own report.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from scilab_rl.config.compose import compose, explain_error, friendly_override, typed_overrides
    from scilab_rl.config.workspace import open_project
    from scilab_rl.results import RunResult
    from scilab_rl.search.folders import expand_from_study

    results: list[RunResult] = []
    errors: list[Exception] = []

    @hydra.main(version_base="1.3", config_path="pkg://scilab_rl.conf", config_name="main")
    def task(composed: Any) -> float | None:
        from scilab_rl.run.run import start_run

        chosen, overrides = HydraConfig.get(), typed_overrides()
        try:
            if chosen.mode is RunMode.RUN and chosen.runtime.choices["hydra/launcher"] != "basic":
                from scilab_rl.parallel.launchers import refuse_for_single_run

                refuse_for_single_run(chosen.launcher)
            results.append(start_run(compose(overrides, composed), overrides))
        except Exception as error:  # noqa: BLE001 - reported below; the other runs of a sweep continue
            errors.append(error)
            return None
        return results[-1].score

    open_project()
    arguments = expand_from_study(arguments)
    # Hydra takes overrides before its flags only.
    arguments.sort(key=lambda argument: argument in ("--multirun", "-m"))
    original, sys.argv = sys.argv, [sys.argv[0], *map(friendly_override, arguments)]
    try:
        task()
    except ScilabRLError:
        raise
    except Exception as error:
        raise explain_error(error) from error
    finally:
        sys.argv = original
    if errors:
        raise _summary_of(errors, n_runs=len(errors) + len(results))
    return results[-1].exit_code if results else 0


def _summary_of(errors: Sequence[Exception], n_runs: int) -> ScilabRLError:
    """Return one error for all failed runs."""
    from scilab_rl.config.compose import explain_error

    ours = [e if isinstance(e, ScilabRLError) else explain_error(e) for e in errors]
    nothing_started = len(ours) == n_runs and all(isinstance(e, ConfigError) for e in ours)
    if n_runs == 1 or nothing_started:
        return ours[0]
    return SomeRunsFailedError(f"{len(ours)} of {n_runs} runs failed, first with: {ours[0]}")


def _set_up_messages(debug: bool) -> None:
    """Log to standard error, one line per message, and silence libraries."""
    logger = logging.getLogger("scilab_rl")
    logger.handlers.clear()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(RedactingFormatter("%(message)s"))
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if debug else logging.INFO)
    logger.propagate = False
    # Our one-line error contains what Hydra logs before it raises.
    logging.getLogger("hydra").addHandler(logging.NullHandler())
    if not debug and not sys.warnoptions:
        # Deprecations of our dependencies do not concern users.
        warnings.simplefilter("ignore")
        os.environ.setdefault("PYTHONWARNINGS", "ignore")


if __name__ == "__main__":
    main()
