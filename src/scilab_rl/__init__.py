"""Scilab-RL: goal-conditioned reinforcement learning that shows what the agent thinks.

Importing the package imports nothing heavy: simulators, PyTorch and trackers are loaded where they
are used.
"""

__version__ = "1.0.0.dev0"
