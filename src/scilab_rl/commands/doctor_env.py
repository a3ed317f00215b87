"""``scilab-rl doctor env=ID``: check an environment before one trains in it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import hydra

from scilab_rl import assembly, config
from scilab_rl.findings import Finding
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)


def examine(overrides: Sequence[str], n_steps: int) -> list[Finding]:
    """Examine the environment of a command line, with its arguments and wrappers.

    Args:
        overrides: For example ``env=FetchReach`` and ``env_kwargs.reward_type=dense``.
        n_steps: Random steps on which rewards are compared.

    Raises:
        ConfigError: If there is no such environment.
    """
    open_desk()
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        overrides = [config.friendly_override(word) for word in overrides]
        cfg = assembly.complete(config.compose(["tuned=false", *overrides]))
    # Imported late: Gymnasium takes its time.
    from scilab_rl.envs import examination, fingerprint
    from scilab_rl.envs.vectorize import make_single_env

    settings = assembly.env_settings(cfg)
    known = () if settings.env_kwargs or settings.wrappers else fingerprint.known(cfg.env)
    _log.info("Examining %s with %d random steps.", cfg.env, n_steps)
    found = examination.examine(
        lambda: make_single_env(replace(settings, vector="inprocess")),
        n_steps=n_steps,
        known_fingerprints=known,
    )
    return list(found)
