"""Policies that Stable-Baselines3 saved: zips that may carry a pickle, and so any program.

They are loaded only when the user says so on the command line, with ``--trust-pickle``.
"""

from __future__ import annotations

import logging
import os
import zipfile
from operator import attrgetter
from pathlib import Path

from scilab_rl.errors import CheckpointError, ConfigError

# In the environment, so that the worker processes of a study read it too.
TRUST_VARIABLE = "SCILAB_RL_TRUST_PICKLE"
_log = logging.getLogger(__name__)


def find_archive(path: Path) -> Path | None:
    """Return the zip that a path names, with or without its suffix, or None if it names none."""
    if path.is_dir():
        return None
    for candidate in (path, path.with_name(f"{path.name}.zip")):
        if candidate.is_file() and zipfile.is_zipfile(candidate):
            return candidate
    return None


def refuse_untrusted(archive: Path) -> None:
    """Reject a zip that the user has not said to trust, before anything of it is read.

    Raises:
        ConfigError: With the flag that is missing.
    """
    if os.environ.get(TRUST_VARIABLE) != "1":
        raise ConfigError(
            f"'{archive}' is a zip of Stable-Baselines3, which can run any code when it is loaded "
            "(pickle). If you trust its source, add --trust-pickle."
        )


def load_archive(model: object, archive: Path) -> None:
    """Put the weights and optimizers of a trusted zip into an algorithm of the same kind.

    Args:
        model: An algorithm of Stable-Baselines3, built with the same networks.
        archive: The zip.

    Raises:
        ConfigError: If it is not trusted, or the algorithm is none of Stable-Baselines3.
        CheckpointError: If it is damaged or was saved by another algorithm.
    """
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.save_util import load_from_zip_file

    refuse_untrusted(archive)
    if not isinstance(model, BaseAlgorithm):
        raise ConfigError(
            f"'{archive}' is a zip of Stable-Baselines3, but {type(model).__name__} is a one-file "
            "algorithm. Choose the algorithm that it was saved by, for example algorithm=sac."
        )
    _log.warning("Loading '%s' as you trust its source: such a file can run any code.", archive)
    try:
        # The settings in it are not needed: the configuration has them.
        _, parameters, variables = load_from_zip_file(archive, load_data=False, device=model.device)
        model.set_parameters(parameters, device=model.device)
        for name, value in (variables or {}).items():
            attrgetter(name)(model).data = value.data
    except Exception as error:  # whatever reading an unknown file can raise
        message = " ".join(str(error).split())[:300]
        raise CheckpointError(
            f"'{archive}' does not fit {type(model).__name__} with these settings: {message}"
        ) from error
