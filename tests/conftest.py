"""What holds for all tests."""

import contextlib
import logging
import os
import signal
from collections.abc import Iterator

import pytest

# Before torch is imported: two test workers with two threads each would only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# No test may talk to somebody's account, whatever the machine knows.
for name in ("WANDB_API_KEY", "MLFLOW_TRACKING_URI"):
    os.environ.pop(name, None)

# A shell starts what runs in its background without Ctrl-C, and so would start all our processes.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The contract test lives in the package; its failures must show values like those of test files.
pytest.register_assert_rewrite("scilab_rl.testing.algorithms")


@contextlib.contextmanager
def messages_as_before() -> Iterator[None]:
    """The command line sets up the package's messages; what follows must not see that."""
    logger = logging.getLogger("scilab_rl")
    handlers, level, propagate = list(logger.handlers), logger.level, logger.propagate
    yield
    logger.handlers[:], logger.propagate = handlers, propagate
    logger.setLevel(level)


@pytest.fixture(autouse=True, scope="module")
def _messages_before_module() -> Iterator[None]:
    """Fixtures of a module may use the command line, too."""
    with messages_as_before():
        yield


@pytest.fixture(autouse=True)
def _messages_before_test(_messages_before_module: None) -> Iterator[None]:
    with messages_as_before():
        yield
