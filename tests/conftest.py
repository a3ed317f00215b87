"""What holds for all tests."""

import os

import pytest

# Before torch is imported: two test workers with two threads each would only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# No test may talk to somebody's account, whatever the machine knows.
for name in ("WANDB_API_KEY", "MLFLOW_TRACKING_URI"):
    os.environ.pop(name, None)

# The exam lives in the package; its failures shall show values as those of test files do.
pytest.register_assert_rewrite("scilab_rl.testing.algorithms")
