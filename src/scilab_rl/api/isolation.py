"""A training or an evaluation inside somebody's program leaves the program as it was."""

from __future__ import annotations

import contextlib
import logging
import random
import sys
from collections.abc import Iterator

import numpy as np

from scilab_rl.redaction import RedactingFormatter


@contextlib.contextmanager
def isolated() -> Iterator[None]:
    """Restore random generators and numbers of threads after the block.

    Signal handlers and Hydra's global state are restored by those who change them. What stays are
    ``MUJOCO_GL``, without which later pictures would fail, and the switches of `telemetry`.
    """
    import torch
    from threadpoolctl import threadpool_limits

    python_state, numpy_state = random.getstate(), np.random.get_state()
    n_threads = torch.get_num_threads()
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_initialized() else []
    with torch.random.fork_rng(devices), threadpool_limits():
        try:
            yield
        finally:
            random.setstate(python_state)
            np.random.set_state(numpy_state)
            torch.set_num_threads(n_threads)


@contextlib.contextmanager
def messages(*, quiet: bool) -> Iterator[None]:
    """Print the package's messages on standard error, as the command line does.

    A program that has set up logging for itself gets them its own way.

    Args:
        quiet: Whether only warnings are printed.
    """
    logger = logging.getLogger("scilab_rl")
    before = logger.level, logger.propagate
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(RedactingFormatter("%(message)s"))
    handler.setLevel(logging.WARNING if quiet else logging.INFO)
    is_set_up = logger.hasHandlers()
    logger.setLevel(before[0] or logging.INFO)
    if not is_set_up:
        logger.propagate = False
        logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before[0])
        logger.propagate = before[1]
