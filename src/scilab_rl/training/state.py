"""All that the rest of a training run depends on, in one place.

The state is captured where an algorithm begins a rollout: the last transition is stored, the last
update is done, nothing is pending. Simulators are not saved; their episodes are replayed, see
`envs.run_env`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from stable_baselines3.common.vec_env import VecEnvWrapper

from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.metrics.store import MetricStore
from scilab_rl.training.snapshot import Snapshot, capture, random_state
from scilab_rl.training.statistics import RolloutStatistics

# What each layer of a vector environment has.
_COMMON = (
    "venv", "class_attributes", "num_envs", "observation_space", "action_space", "render_mode",
    "metadata", "reset_infos", "_seeds", "_options",
)  # fmt: skip


@dataclass
class RunState:
    """The parts of a run that change while it learns.

    Attributes:
        model: The algorithm, with its environments.
        logger: What the algorithm records to.
        statistics: Of the training episodes.
        store: One row of metrics per epoch.
        best: What the best policy so far has reached, see `callbacks.KeepBest`.
    """

    model: Algorithm
    logger: MetricLogger
    statistics: RolloutStatistics
    store: MetricStore = field(default_factory=MetricStore)
    best: tuple[float, ...] | None = None

    @property
    def layers(self) -> list[VecEnvWrapper]:
        """The layers above the one that is observed, from the outside in."""
        layers, env = [], self.model.get_env()
        while isinstance(env, VecEnvWrapper) and not isinstance(env, ObservedVecEnv):
            layers.append(env)
            env = env.venv
        return layers

    def parts(self, *, with_episodes: bool = True) -> dict[str, object]:
        """Return name to object.

        Args:
            with_episodes: Whether the running episodes belong to it; otherwise a resumed run begins
                new ones.
        """
        env = observed_layer(self.model.get_env())
        return {
            "algorithm": self.model,
            "normalization": [
                {name: value for name, value in vars(layer).items() if name not in _COMMON}
                for layer in self.layers
            ],
            "environments": env.env_method("episode_state") if with_episodes else [],
            "observed": env.state(),
            "statistics": self.statistics,
            "recorded": self.logger.state(),
            "history": {"steps": self.store.steps, "rows": self.store.rows},
            "best": self.best,
            "random": random_state(),
        }

    def capture(self, *, with_episodes: bool = True) -> Snapshot:
        """Return a snapshot; its tensors and arrays are views that later steps change."""
        return capture(self.parts(with_episodes=with_episodes))
