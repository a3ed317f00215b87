"""What holds for all tests."""

import os
import signal

import pytest

# Before torch is imported: two test workers with two threads each would only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# No test may talk to somebody's account, whatever the machine knows.
for name in ("WANDB_API_KEY", "MLFLOW_TRACKING_URI"):
    os.environ.pop(name, None)

# A shell starts what runs in its background without Ctrl-C, and so would start all our processes.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The exam lives in the package; its failures shall show values as those of test files do.
pytest.register_assert_rewrite("scilab_rl.testing.algorithms")
