"""Scilab-RL: goal-conditioned reinforcement learning that shows what the agent thinks.

.. code-block:: python

    import scilab_rl

    run = scilab_rl.train(env="FetchReach", algorithm="cleansac", n_epochs=5, seed=1)
    agent = scilab_rl.load("agent:FetchPush")
    env = agent.make_env(render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    action = agent.predict(observation)

Importing the package imports nothing heavy: simulators, PyTorch and trackers are loaded where they
are used. The environments are registered with Gymnasium as soon as both packages are imported, in
either order.
"""

from __future__ import annotations

from scilab_rl.envs.on_import import register_when_imported

TYPE_CHECKING = False  # that of `typing`, whose import would take longer than all the rest
if TYPE_CHECKING:
    from scilab_rl.api.agent import Agent, EvaluationSummary, load
    from scilab_rl.api.comparison import ComparisonSummary, compare
    from scilab_rl.api.goals import GoalSummary, goals
    from scilab_rl.api.run import Run, runs, train
    from scilab_rl.errors import ConfigError, ScilabRLError

__version__ = "1.0.0.dev0"
# Name to the module that it is imported from when it is used first.
_API = {
    "Agent": "scilab_rl.api.agent",
    "ComparisonSummary": "scilab_rl.api.comparison",
    "ConfigError": "scilab_rl.errors",
    "EvaluationSummary": "scilab_rl.api.agent",
    "GoalSummary": "scilab_rl.api.goals",
    "Run": "scilab_rl.api.run",
    "ScilabRLError": "scilab_rl.errors",
    "compare": "scilab_rl.api.comparison",
    "goals": "scilab_rl.api.goals",
    "load": "scilab_rl.api.agent",
    "runs": "scilab_rl.api.run",
    "train": "scilab_rl.api.run",
}
__all__ = [
    "Agent", "ComparisonSummary", "ConfigError", "EvaluationSummary", "GoalSummary", "Run",
    "ScilabRLError", "__version__", "compare", "goals", "load", "runs", "train",
]  # fmt: skip


if not TYPE_CHECKING:  # type checkers know the names above, and would take any other for one

    def __getattr__(name: str) -> object:
        if name not in _API:
            raise AttributeError(f"module 'scilab_rl' has no attribute '{name}'")
        import importlib

        found = globals()[name] = getattr(importlib.import_module(_API[name]), name)
        return found


def __dir__() -> list[str]:
    return __all__


register_when_imported()
