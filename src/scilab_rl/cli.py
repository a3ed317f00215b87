"""The command line: ``scilab-rl KEY=VALUE ...`` trains, ``scilab-rl COMMAND ...`` does the rest."""

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

from scilab_rl import __version__
from scilab_rl.errors import ConfigError, ScilabRLError, SomeRunsFailedError, did_you_mean
from scilab_rl.masking import MaskingFormatter, mask

COMMANDS = {
    "play": "watch or film a trained policy and measure its success",
    "view": "look at recorded episodes",
    "probe": "compute metrics for recorded episodes, also with other checkpoints",
    "resume": "continue an interrupted run",
    "new": "create an algorithm of your own from an existing one",
    "runs": "list the recorded runs",
    "profile": "train for a little while and show where the time goes",
    "study": "show what a hyperparameter study has found",
    "compare": "tell which of several algorithms, groups or runs learns better",
    "experiment": "train what is missing of a comparison, then compare",
    "performance": "test whether everything still learns as well as it did",
    "export": "write what an agent saw, did and thought as a tidy table",
    "sync": "send runs to a tracker that was away while they trained",
    "algorithms": "list the algorithms",
    "envs": "list the environments",
    "explain": "show where the value of a key comes from",
    "clean": "remove what killed processes have left behind",
    "doctor": "check the installation and say how to repair it",
}
EXIT_INTERRUPTED, EXIT_PIPE_CLOSED = 130, 141
# Of Hydra, which would answer others with a page of usage.
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
    os.environ["SCILAB_RL_TRUST_PICKLE"] = str(int(trusts_pickle))  # see `training.foreign`
    try:
        return _dispatch(arguments)
    except ScilabRLError as error:
        if debug:
            traceback.print_exc()
        sys.stderr.write(f"error: {_one_line(error)}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as in `scilab-rl runs | head`
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


def _fill_closed_streams() -> None:
    """Give a process that was started without standard streams ones that lead nowhere.

    Otherwise the first files that it opens would get their numbers, and what is printed.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open("w")
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")


def _one_line(error: Exception) -> str:
    """Return what an error says, without secrets and without control characters."""
    line = mask(" ".join(str(error).split()))
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def _dispatch(arguments: list[str]) -> int:
    first = arguments[0] if arguments else ""
    if "--version" in arguments:
        sys.stdout.write(f"scilab-rl {__version__}\n")
        return 0
    if first in COMMANDS:
        module = importlib.import_module(f"scilab_rl.commands.{first}")
        return int(module.main(arguments[1:]) or 0)
    if first in ("-h", "--help"):
        from scilab_rl.commands.help import print_help

        print_help(COMMANDS)
        return 0
    if first and not first.startswith(("-", "~")) and "=" not in first and first != "train":
        if first.lstrip("+") in config_keys():
            raise ConfigError(f"{first} needs a value: {first}=VALUE.")
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
                "without dashes, as in n_epochs=3; `scilab-rl --help` lists keys and flags."
            )


def _with_host_as_key(arguments: list[str]) -> list[str]:
    """Turn ``--host ADDRESS`` into the key ``viewer_host``."""
    if "--host" not in arguments:
        return arguments
    index = arguments.index("--host")
    if index + 1 == len(arguments):
        raise ConfigError("--host needs an address, for example --host 0.0.0.0.")
    return [*arguments[:index], f"viewer_host={arguments[index + 1]}", *arguments[index + 2 :]]


def config_keys() -> list[str]:
    """Return the keys of the configuration."""
    from scilab_rl.config import ALIASES, GROUPS, KEYS

    return [*(key.name for key in KEYS), *GROUPS, *ALIASES]


def train(arguments: list[str]) -> int:
    """Hand the arguments to Hydra, which composes the configuration and calls the experiment."""
    # Errors shall come to us as exceptions, not as Hydra's report.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    import hydra
    from hydra.core.hydra_config import HydraConfig

    from scilab_rl.config import compose, explain_error, friendly_override
    from scilab_rl.hyperopt.folders import expand_best_of
    from scilab_rl.workspace import open_desk

    results: list[Any] = []
    errors: list[Exception] = []

    @hydra.main(version_base="1.3", config_path="pkg://scilab_rl.conf", config_name="main")
    def task(_: Any) -> float | None:
        from scilab_rl import experiment

        overrides = list(HydraConfig.get().overrides.task)
        try:
            results.append(experiment.run(compose(overrides), overrides))
        except Exception as error:  # noqa: BLE001 - reported below; the other runs of a sweep go on
            errors.append(error)
            return None
        return results[-1].score

    open_desk()
    arguments = expand_best_of(arguments)
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
    """Return what to tell about the runs that failed."""
    from scilab_rl.config import explain_error

    ours = [e if isinstance(e, ScilabRLError) else explain_error(e) for e in errors]
    nothing_started = len(ours) == n_runs and all(isinstance(e, ConfigError) for e in ours)
    if n_runs == 1 or nothing_started:
        return ours[0]
    return SomeRunsFailedError(f"{len(ours)} of {n_runs} runs failed, first with: {ours[0]}")


def _set_up_messages(debug: bool) -> None:
    """Send notices to standard error, one line each, and keep libraries quiet."""
    logger = logging.getLogger("scilab_rl")
    logger.handlers.clear()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(MaskingFormatter("%(message)s"))
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if debug else logging.INFO)
    logger.propagate = False
    if not debug and not sys.warnoptions:
        # Deprecations of our dependencies are our business, not the user's.
        warnings.simplefilter("ignore")
        os.environ.setdefault("PYTHONWARNINGS", "ignore")


if __name__ == "__main__":
    main()
