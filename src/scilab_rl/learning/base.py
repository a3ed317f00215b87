"""The base of one-file algorithms: environments, callbacks, `predict`.

None of the learning is here, and none of this is in an algorithm's file. The interface is that of
Stable-Baselines3, so that its callbacks, replay buffers and vector environments work unchanged.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, TypeAlias, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import (
    get_device,
    is_vectorized_observation,
    set_random_seed,
)
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from scilab_rl.canonical_spaces import check_canonical
from scilab_rl.envs.types import Observation
from scilab_rl.envs.vec_step import VecStep, decode_step
from scilab_rl.errors import ConfigError, NumericalError
from scilab_rl.learning.declared import MetricEntry
from scilab_rl.learning.finite import check_finite, check_finite_weights
from scilab_rl.learning.observations import Tensors, batch_of_one, to_vector
from scilab_rl.metrics.logger import MetricLogger

# Hyperparameters named in the message when a number is no longer one.
SHOWN_WITH_NAN = ("learning_rate", "gamma", "batch_size")
Self = TypeVar("Self", bound="OneFileAlgorithm")
Recalled: TypeAlias = tuple[np.ndarray, ...] | None  # what a policy with a memory knows


class OneFileAlgorithm(ABC):
    """The plumbing of an algorithm; a subclass adds `iterate` and `act`.

    All state lies in attributes, and nothing is pending when ``callback.on_rollout_start`` is
    called: that is where a checkpoint is taken, and from where it continues exactly.

    Args:
        env: Vector environment to learn in.
        seed: Seed of the weights, the exploration and the environments; None: do not seed.
        device: ``auto``, ``cpu``, ``cuda``, ...

    Attributes:
        supported_action_spaces: What kinds of actions the algorithm can choose.
        metrics: What it records, see `scilab_rl.learning.declared`.
        num_timesteps: Environment steps so far, over all environments.
        n_updates: Gradient steps so far.
        logger: Takes metrics: ``self.logger.record("train/critic_loss", loss)``.
    """

    supported_action_spaces: ClassVar[tuple[type[spaces.Space], ...]]
    metrics: ClassVar[Sequence[MetricEntry]] = ()

    def __init__(self, *, env: VecEnv, seed: int | None = None, device: str = "auto") -> None:
        self.env = env
        self.n_envs = env.num_envs
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        if not isinstance(self.action_space, self.supported_action_spaces):
            allowed = " or ".join(kind.__name__ for kind in self.supported_action_spaces)
            raise ConfigError(
                f"{type(self).__name__} needs {allowed} actions, but the environment has "
                f"{type(self.action_space).__name__} actions."
            )
        check_canonical(type(self).__name__, env)
        self.device = get_device(device)
        self.seed = seed
        self.logger = MetricLogger()
        self.num_timesteps = 0
        self.n_updates = 0
        self._total_timesteps = 0
        self._last_obs: Any = None
        if seed is not None:
            set_random_seed(seed, using_cuda=self.device.type == "cuda")
            self.action_space.seed(seed)
            env.seed(seed)

    @abstractmethod
    def iterate(self, callback: BaseCallback) -> bool:
        """Collect experience, then learn from it.

        Args:
            callback: ``on_rollout_start`` and ``on_rollout_end`` surround the collecting.

        Returns:
            False if the callback stops.
        """

    @abstractmethod
    def act(self, observations: torch.Tensor, deterministic: bool) -> torch.Tensor:
        """Choose actions, in the units in which the algorithm learns.

        Shapes:
            observations: ``(batch, n_observations)``; result: what `to_env_actions` understands.
        """

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = None,
        reset_num_timesteps: bool = True,
    ) -> Self:
        """Learn for a number of environment steps.

        Args:
            total_timesteps: Steps over all environments.
            callback: A callback of Stable-Baselines3, a list of them, a function or None.
            log_interval: Accepted for Stable-Baselines3, ignored: the framework logs.
            reset_num_timesteps: False continues where an earlier call, or a checkpoint, ended.
        """
        callback = self._begin(total_timesteps, callback, reset_num_timesteps)
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < self._total_timesteps and self.iterate(callback):
            pass
        callback.on_training_end()
        return self

    def predict(
        self,
        observation: Observation,
        state: Recalled = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Recalled]:
        """Choose actions for observations as the environment gives them.

        Args:
            observation: One observation or a batch of them.
            state: What the last call has returned.
            episode_start: Ignored: an observation shows a memory when to begin anew.
            deterministic: Whether the most likely action is taken.

        Returns:
            Actions in the environment's bounds, batched if the observations are, and the state,
            unchanged by policies without memory.
        """
        is_batch = is_vectorized_observation(observation, self.observation_space)  # type: ignore[arg-type]
        batch = observation if is_batch else batch_of_one(observation)
        actions, state = self.choose_actions(batch, state, deterministic)
        return (actions if is_batch else actions[0]), state

    def choose_actions(
        self, observations: Observation, state: Recalled, deterministic: bool
    ) -> tuple[np.ndarray, Recalled]:
        """Choose actions in the environment's bounds for a batch; see `predict`."""
        with torch.no_grad():
            actions = self.act(self.to_vector(observations), deterministic)
            return self.to_env_actions(actions), state

    def set_logger(self, logger: MetricLogger) -> None:
        """Let metrics be recorded by this logger."""
        self.logger = logger

    def get_env(self) -> VecEnv:
        """Return the environment that the algorithm learns in."""
        return self.env

    def step(self, actions: np.ndarray, callback: BaseCallback) -> VecStep | None:
        """Act in all environments and tell the callback.

        Args:
            actions: In the environment's bounds. Shapes: ``(n_envs, ...)``.
            callback: Its ``on_step`` is called.

        Returns:
            What happened, or None if the callback stops; the step is then forgotten.
        """
        new_obs: Any
        self.env.step_async(actions)
        self.while_stepping()
        new_obs, rewards, dones, infos = self.env.step_wait()
        self.num_timesteps += self.n_envs
        callback.update_locals(
            {
                "actions": actions,
                "new_obs": new_obs,
                "rewards": rewards,
                "dones": dones,
                "infos": infos,
            }
        )
        if not callback.on_step():
            self._break_off(new_obs)
            return None
        step = decode_step(self._last_obs, actions, new_obs, rewards, dones, infos)
        self._last_obs = new_obs
        return step

    def while_stepping(self) -> None:  # noqa: B027 - nothing to do is a full answer
        """Do what can be done while the environments step; nothing by default."""

    def to_vector(self, observations: Observation | Tensors) -> torch.Tensor:
        """Turn observations of any kind into one vector each.

        Shapes:
            result: ``(batch, n_observations)``.
        """
        return to_vector(observations, self.observation_space, self.device)

    @property
    def n_observations(self) -> int:
        """Length of an observation as a vector."""
        return spaces.flatdim(self.observation_space)

    @property
    def n_actions(self) -> int:
        """Number of discrete actions, or of dimensions of a continuous one."""
        if isinstance(self.action_space, spaces.Discrete):
            return int(self.action_space.n)
        return spaces.flatdim(self.action_space)

    def to_env_actions(self, actions: torch.Tensor) -> np.ndarray:
        """Turn the algorithm's actions into the environment's: from [-1, 1] into its bounds.

        Raises:
            NumericalError: If an action is not finite.
        """
        values = actions.cpu().numpy()
        space = self.action_space
        if isinstance(space, spaces.Discrete):
            return values.reshape(-1)
        if not isinstance(space, spaces.Box):
            return values
        if not np.isfinite(values).all():
            raise NumericalError(
                f"An action of the policy is {values.flatten().tolist()} after {self.n_updates} "
                "updates: its weights are not finite. Often the learning rate is too high."
            )
        values = values.reshape(-1, *space.shape)
        scaled = space.low + 0.5 * (values + 1.0) * (space.high - space.low)
        return np.clip(scaled, space.low, space.high).astype(space.dtype)

    def from_env_actions(self, actions: np.ndarray) -> np.ndarray:
        """Turn the environment's actions into the algorithm's: from its bounds into [-1, 1].

        Shapes:
            result: ``(batch, n_actions)`` for continuous actions, ``(batch, 1)`` for discrete.
        """
        space = self.action_space
        if isinstance(space, spaces.Discrete):
            return np.asarray(actions).reshape(-1, 1)
        if not isinstance(space, spaces.Box):
            return np.asarray(actions)
        scaled = 2.0 * (np.asarray(actions) - space.low) / (space.high - space.low) - 1.0
        return scaled.reshape(len(scaled), -1).astype(np.float32)

    def sample_env_actions(self, n: int | None = None) -> np.ndarray:
        """Draw ``n`` random actions of the environment's; by default one per environment."""
        return np.array([self.action_space.sample() for _ in range(n or self.n_envs)])

    def record_losses(self, losses: Mapping[str, Sequence[torch.Tensor]]) -> None:
        """Record the mean of each loss as ``train/<name>``, and refuse what is not finite.

        Args:
            losses: Name to one value per update since the last call.

        Raises:
            NumericalError: If a loss, or a weight of any of the networks, is not finite.
        """
        shown = {name: getattr(self, name) for name in SHOWN_WITH_NAN if hasattr(self, name)}
        for name, values in losses.items():
            stacked = torch.stack(tuple(values))
            check_finite(name, stacked, self.n_updates, **shown)
            self.logger.record(f"train/{name}", stacked.mean())
        for name, value in vars(self).items():
            # Target networks follow the others, and are read in the losses.
            if isinstance(value, nn.Module) and any(p.requires_grad for p in value.parameters()):
                check_finite_weights(name, value, self.n_updates, **shown)

    def record_dimensions(self, name: str, vector: torch.Tensor | np.ndarray) -> None:
        """Record each entry of a vector as ``<name>_<index>``."""
        for index, value in enumerate(vector.flatten().tolist()):
            self.logger.record(f"{name}_{index}", value)

    def _begin(
        self, total_timesteps: int, callback: MaybeCallback, reset_num_timesteps: bool
    ) -> BaseCallback:
        if reset_num_timesteps:
            self.num_timesteps = 0
        self._total_timesteps = self.num_timesteps + total_timesteps
        if reset_num_timesteps or self._last_obs is None:
            self._break_off(self.env.reset())  # type: ignore[arg-type]
        if isinstance(callback, list):
            callback = CallbackList(callback)
        if not isinstance(callback, BaseCallback):
            callback = ConvertCallback(callback)
        callback.init_callback(self)  # type: ignore[arg-type]
        return callback

    def _break_off(self, observations: Observation) -> None:
        """Go on from observations that do not follow from the last step."""
        self._last_obs = observations


class LazyNumber:
    """A metric that is computed only if it is watched.

    ``record`` is called at every step, but a value is looked at once per epoch or once per frame.
    The logger treats it as an array with one element.

    Args:
        compute: Returns a number or a tensor with one element.
    """

    size = 1

    def __init__(self, compute: Callable[[], torch.Tensor | float]) -> None:
        self.compute = compute

    def item(self) -> float:
        """Return the number."""
        with torch.no_grad():
            return float(self.compute())
