"""The loop of offline algorithms in JAX: updates from a data set, and no step of an environment.

Nothing here knows what is learned. What other algorithms count in environment steps is counted in
updates here: ``num_timesteps`` is the number of updates, and so are the steps of an epoch, of a
checkpoint and of a learning curve. Environments are there to evaluate in, and for their spaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from stable_baselines3.common.callbacks import BaseCallback

from scilab_rl.errors import ConfigError
from scilab_rl.learning.declared import MetricEntry
from scilab_rl.learning.jax_off_policy import JaxOffPolicyAlgorithm
from scilab_rl.learning.replay import HindsightReplayBuffer, can_hold


class JaxOfflineAlgorithm(JaxOffPolicyAlgorithm):
    """Learns from episodes that lie in its replay buffer before the first update.

    A run puts them there, see `scilab_rl.run.demonstrations`. A subclass has a parameter ``data``,
    which names them, and adds `act` and its update.

    Args:
        train_freq: Updates of a round, which is one compiled call. With several environments the
            callback counts so many steps at once, and a round has as many times more updates.
        **common: See `JaxOffPolicyAlgorithm`.
    """

    learns_offline = True
    needs_goals = True
    metrics: ClassVar[Sequence[MetricEntry]] = (
        ("train/rollout_q_step", "it acts to learn, and offline it does not", lambda self: False),
    )

    def __init__(self, *, train_freq: int = 20, **common: Any) -> None:
        if not can_hold(common["env"].observation_space):
            raise ConfigError(
                f"{type(self).__name__} needs our own hindsight replay, whose observations are "
                "floating-point arrays."
            )
        super().__init__(
            train_freq=train_freq,
            gradient_steps=-1,
            learning_starts=0,
            buffer_size=1,  # nothing is added to what the agent itself experiences
            replay_buffer_class=HindsightReplayBuffer,
            **common,
        )

    def iterate(self, callback: BaseCallback) -> bool:
        """Do a round of updates, then count them."""
        callback.on_rollout_start()
        self.train(self.updates_per_round)
        for _ in range(self.train_freq):
            self.num_timesteps += self.n_envs
            if not callback.on_step():
                return False
        callback.on_rollout_end()
        return True
