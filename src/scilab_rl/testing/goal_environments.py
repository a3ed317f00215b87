"""The contract test of every environment.

An environment of your own takes it with three lines in a test file:

.. code-block:: python

    from scilab_rl.testing.goal_environments import EnvironmentContract

    class TestMyReach(EnvironmentContract):
        env = "MyReach-v0"

The same checks are made by ``scilab-rl doctor env=MyReach-v0``, with what to do about each fault.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from scilab_rl.check_results import FAIL, WARN
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs import fingerprint
from scilab_rl.envs.checker import check_environment
from scilab_rl.envs.vectorize import make_single_env


class EnvironmentContract:
    """Subclass it, name an environment, and pytest does the rest.

    Attributes:
        env: Its id.
        env_kwargs: Its keyword arguments.
        n_steps: Random steps on which rewards and endings are compared.
        accepted: Checks whose warnings you know and accept.
    """

    env: str
    env_kwargs: Mapping[str, Any] = {}
    n_steps = 1000
    accepted: tuple[str, ...] = ()

    def test_doctor_finds_no_fault(self) -> None:
        """Shapes, rewards, success, endings, goals, seeds, pickling, stability."""
        make = partial(make_single_env, RunConfig(self.env, self.env_kwargs))
        faults = [
            f"{finding.check}: {finding.found} ({finding.fix})"
            for finding in check_environment(
                make, n_steps=self.n_steps, known_fingerprints=fingerprint.known(self.env)
            )
            if finding.result in (WARN, FAIL) and finding.check not in self.accepted
        ]
        assert faults == []
