"""The fixtures of the algorithms' tests, for what algorithms are made of."""

from ..algorithms.conftest import _one_thread, make_env  # noqa: F401
