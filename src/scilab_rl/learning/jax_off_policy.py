"""The loop of off-policy algorithms in JAX: environments step while a round of updates computes.

Nothing here knows what is learned. Besides the loop, it has the options that make sparse rewards
learnable with fewer steps; `jaxsac` says where they are from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.her import HerReplayBuffer
from torch import Tensor

from scilab_rl.envs.types import Observation
from scilab_rl.envs.vec_step import VecStep
from scilab_rl.errors import ConfigError
from scilab_rl.learning.declared import MetricEntry
from scilab_rl.learning.jax_engine import (
    Array,
    Batch,
    Normalizer,
    Params,
    State,
    UpdateRunner,
    dense_layers,
    forward,
    return_bounds,
    split_into_updates,
)
from scilab_rl.learning.nn import checked_precision
from scilab_rl.learning.observations import Tensors
from scilab_rl.learning.off_policy import OffPolicyAlgorithm
from scilab_rl.learning.relay import make_relay
from scilab_rl.learning.replay import HindsightReplayBuffer
from scilab_rl.metrics.success import success_of

Losses = dict[str, Array]
CriticLoss = Callable[[Params, Batch, Array, str], tuple[Array, Array]]
S = TypeVar("S", bound="UpdateSettings")
# Weight of the last training episode in the success rate that exploration follows.
_NEWEST_SHARE = 0.05


@dataclass(frozen=True)
class UpdateSettings:
    """The constants of an update, for which it is compiled; see `JaxOffPolicyAlgorithm`."""

    learning_rate: float
    gamma: float
    tau: float
    n_target_critics: int
    policy_delay: int
    precision: str

    @classmethod
    def of(cls: type[S], algorithm: JaxOffPolicyAlgorithm, **own: Any) -> S:
        """Return the settings of an algorithm.

        Args:
            algorithm: Has the common ones as attributes.
            **own: Those that a subclass adds.
        """
        values: dict[str, Any] = {
            f.name: getattr(algorithm, f.name) for f in fields(UpdateSettings)
        }
        return cls(**values, **own)


class JaxOffPolicyAlgorithm(OffPolicyAlgorithm):
    """Collects steps while the last round of updates computes.

    A subclass calls `start_learning` at the end of its constructor, and adds `act`.

    Args:
        gradient_steps: Updates per round; -1: as many as steps were collected.
        random_actions: Share of uniformly random actions after ``learning_starts``.
        random_actions_end: That share when every training episode reaches its goal; between the
            two it follows the success rate (Yang et al., 2022, arXiv 2207.09243). An episode counts
            whose goal was reached at any step: exploration often leaves it again. None: constant.
        n_critics: Number of critics.
        n_target_critics: How many of them, drawn at random for each update, give the target;
            None: all.
        policy_delay: Critic updates per update of the actor.
        bounded_targets: Whether targets are clipped to what returns can be.
        normalize_observations: Whether the networks see observations of unit variance.
        layer_norm: Whether the critics normalize their hidden layers.
        net_arch: Sizes of the hidden layers of actor and critics.
        precision: ``float32`` or ``bfloat16``, of the matrix products.
        overlap: Whether the environments step while a round of updates computes.
        relay: A goal before the task's, see `scilab_rl.learning.relay`: where effector and
            object are in the observation. None: none.
        device: Where JAX computes: ``auto`` (a GPU if JAX has one), ``cpu`` or ``cuda``.
        **common: Learning rate, batch size, gamma and so on, see `OffPolicyAlgorithm`.
    """

    metrics: ClassVar[Sequence[MetricEntry]] = (
        "train/critic_loss",
        "train/actor_loss",
        "train/q_mean",
        # Over the target critics.
        ("train/target_critic_variance", "n_critics is above 1", lambda self: self.n_critics > 1),
    )

    def __init__(
        self,
        *,
        gradient_steps: int = -1,
        random_actions: float = 0.0,
        random_actions_end: float | None = None,
        n_critics: int = 2,
        n_target_critics: int | None = None,
        policy_delay: int = 1,
        bounded_targets: bool = False,
        normalize_observations: bool = False,
        layer_norm: bool = False,
        net_arch: Sequence[int] = (256, 256),
        precision: str = "float32",
        overlap: bool = True,
        relay: Mapping[str, object] | None = None,
        device: str = "auto",
        **common: Any,
    ) -> None:
        # PyTorch is on the CPU, where the replay buffer is.
        super().__init__(gradient_steps=gradient_steps, device="cpu", **common)
        self.random_actions = random_actions
        self.random_actions_end = random_actions_end
        self.training_success = 0.0  # running mean over episodes
        self._has_succeeded = np.zeros(self.n_envs, bool)  # in the running episodes
        self.n_critics = n_critics
        self.n_target_critics = min(n_target_critics or n_critics, n_critics)
        self.policy_delay = policy_delay
        self.bounded_targets = bounded_targets
        self.layer_norm = layer_norm
        self.net_arch = tuple(net_arch)
        self.precision = checked_precision(precision)
        self.overlap = overlap
        self.relay = make_relay(relay, self.observation_space)
        self.normalizer = Normalizer(
            self.n_observations, active=normalize_observations, n_flags=self.relay is not None
        )
        self.reward_bounds = np.array([np.inf, -np.inf])
        # Gives the next round's transitions; a function, so that no policy is saved with them.
        self._drawn: Callable[[], Batch] | None = None
        self._jax_device = device

    def start_learning(
        self,
        update: Callable[[S, State, Batch, Array, Array], tuple[State, Losses]],
        settings: S,
        state: State,
        shown: Sequence[str] = ("actor", "critic"),
    ) -> None:
        """Compile the updates and make the replay buffer.

        Args:
            update: One gradient step, pure, see `UpdateRunner`.
            settings: Its first argument.
            state: Weights and moments.
            shown: Its networks that act and answer.
        """
        self.rounds = UpdateRunner(partial(update, settings), state, shown, self._jax_device)
        self.make_replay_buffer()

    def draw_networks(self, n_outputs: int) -> tuple[Params, Params]:
        """Draw the weights of an actor with so many outputs, and of the critics."""
        n_inputs = self.n_observations + self.n_actions
        actor = dense_layers([self.n_observations, *self.net_arch, n_outputs])
        critic = dense_layers(
            [n_inputs, *self.net_arch, 1], n=self.n_critics, layer_norm=self.layer_norm
        )
        return actor, critic

    def iterate(self, callback: BaseCallback) -> bool:
        """Collect steps while the last round of updates computes, then start the next round."""
        is_collected = self.collect(callback)
        batch = None if self._drawn is None else self._drawn()
        self._drawn = None
        if not is_collected:
            return False
        if batch is None and self.num_timesteps > self.learning_starts:
            batch = self.draw(self.updates_per_round)
        self.finish_round()
        if batch is not None:
            self.rounds.start(batch)
        if not self.overlap:
            self.finish_round()
        return True

    def while_stepping(self) -> None:
        """Draw the transitions of the next round, in which the present steps cannot be yet.

        The first round is drawn after its steps, since an episode need not have ended before.
        """
        is_due = self.num_timesteps > self.learning_starts  # already before these steps
        if self.overlap and self._drawn is None and is_due:
            batch = self.draw(self.updates_per_round)
            self._drawn = lambda: batch

    def train(self, gradient_steps: int) -> None:
        """Do a round of updates, and wait for it."""
        self.rounds.start(self.draw(gradient_steps))
        self.finish_round()

    def explore(self) -> Tensor:
        """Choose the actions for the next step: random ones at first, and later now and then."""
        random_actions = self.draw_random_actions()
        if self.num_timesteps < self.learning_starts:
            return random_actions
        vectors = self.to_vector(self._last_obs)
        if self.relay is not None:
            vectors = torch.as_tensor(self.relay.choose_goals(vectors.numpy()[:, :-1]))
        actions = self.act(vectors, deterministic=False)
        is_random = torch.as_tensor(np.random.random((self.n_envs, 1)) < self.random_share)
        return torch.where(is_random, random_actions, actions)

    def draw_random_actions(self) -> Tensor:
        """Draw an action in [-1, 1] for each environment, all at once."""
        actions = np.random.uniform(-1.0, 1.0, (self.n_envs, self.n_actions))
        return torch.as_tensor(actions, dtype=torch.float32)

    @property
    def random_share(self) -> float:
        """Share of random actions at the present success rate in training."""
        start, end = self.random_actions, self.random_actions_end
        return start if end is None else start + (end - start) * self.training_success

    def draw(self, n_updates: int) -> Batch:
        """Draw the transitions of a round."""
        batch = self.sample(n_updates * self.batch_size)
        rewards = batch.rewards.numpy().ravel()
        bounds = np.array([-np.inf, np.inf], dtype=np.float32)
        if self.bounded_targets:
            bounds = return_bounds(rewards, self.gamma, self.reward_bounds)
        return split_into_updates(
            n_updates,
            observations=self.normalizer(batch.observations.numpy()),
            actions=batch.actions.numpy(),
            rewards=rewards,
            next_observations=self.normalizer(batch.next_observations.numpy()),
            dones=batch.dones.numpy().ravel(),
            return_bounds=np.tile(bounds, n_updates),
            **self.more_fields(len(rewards)),
        )

    def more_fields(self, n: int) -> dict[str, np.ndarray]:
        """Return more of n transitions that were drawn, for the update; nothing by default."""
        return {}

    def finish_round(self) -> None:
        """Wait for the round under way, and record how it went."""
        losses = self.rounds.finish(
            learning_rate=self.learning_rate, gamma=self.gamma, batch_size=self.batch_size
        )
        self.n_updates = self.rounds.n_started
        for name, values in losses.items():
            self.logger.record(f"train/{name}", values.mean())

    def action_values(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return what each critic of the last finished round thinks of actions."""
        inputs = np.hstack([self.normalizer(observations.numpy()), actions.numpy()])
        values = forward(self.rounds.networks["critic"], inputs, xp=np)
        return torch.as_tensor(values[..., 0].T, dtype=torch.float32)

    def store(self, step: VecStep, actions: np.ndarray) -> None:
        """Add a step to the replay buffer, and update the running moments and the success rate."""
        super().store(step, actions)
        self.normalizer.update(self.to_vector(step.next_observations).numpy())
        if self.random_actions_end is not None:
            self._has_succeeded |= [bool(success_of(info)) for info in step.infos]
            for outcome in self._has_succeeded[step.dones].tolist():
                self.training_success += _NEWEST_SHARE * (outcome - self.training_success)
            self._has_succeeded[step.dones] = False

    @property
    def n_observations(self) -> int:
        """Length of an observation as a vector, with the relay's flag."""
        return super().n_observations + (self.relay is not None)

    def to_vector(self, observations: Observation | Tensors) -> Tensor:
        """Turn observations of any kind into one vector each, with the relay's flag."""
        vectors = super().to_vector(observations)
        if self.relay is None:
            return vectors
        return torch.as_tensor(self.relay.with_flag(vectors.numpy()))

    def make_replay_buffer(self) -> None:
        """Make the replay buffer, with the relay.

        Raises:
            ConfigError: If it cannot have one.
        """
        if self.relay is not None:
            if not issubclass(self._buffer_class or HerReplayBuffer, HindsightReplayBuffer):
                raise ConfigError(
                    "algorithm.relay needs our own hindsight replay; set "
                    "++algorithm.replay_buffer_class=auto or algorithm.relay=null."
                )
            if self._vec_normalize_env is not None:
                raise ConfigError(
                    "algorithm.relay cannot read observations that VecNormalize has changed; use "
                    "algorithm.normalize_observations=true in place of normalize_obs."
                )
            self._buffer_kwargs["relay"] = self.relay
        super().make_replay_buffer()


def update_critics(
    settings: UpdateSettings,
    state: State,
    batch: Batch,
    targets: Array,
    next_q: Array,
    critic_loss: CriticLoss,
) -> tuple[State, Losses]:
    """Take one gradient step with the critics; return the new state and what is recorded.

    Args:
        settings: Constants.
        state: With ``critic``.
        batch: Transitions.
        targets: What the critics should say. Shapes: ``(batch,)``.
        next_q: Values of the target critics. Shapes: ``(n_critics, batch)``.
        critic_loss: Returns the loss and the critics' values.
    """
    (loss, q), gradient = jax.value_and_grad(critic_loss, has_aux=True)(
        state["critic"], batch, targets, settings.precision
    )
    losses = {"critic_loss": loss, "q_mean": q.mean()}
    if len(next_q) > 1:  # one critic has no variance
        losses["target_critic_variance"] = next_q.var(axis=0).mean()
    return adam_step(state, "critic", gradient, settings.learning_rate), losses


def bellman_targets(settings: UpdateSettings, batch: Batch, next_value: Array) -> Array:
    """Return r + gamma (1 - d) v, clipped to what returns can be. Shapes: ``(batch,)``."""
    targets = batch.rewards + settings.gamma * (1 - batch.dones) * next_value
    return jnp.clip(targets, *batch.return_bounds)


def random_subset(values: Array, n: int, key: Array) -> Array:
    """Return n rows, drawn at random; all of them in their order when there are no more."""
    if n == len(values):
        return values
    return values[jax.random.permutation(key, len(values))[:n]]


def delayed(
    settings: UpdateSettings, index: Array, update: Callable[[State], State], state: State
) -> State:
    """Return the state after an update that is done once in ``policy_delay`` times.

    Args:
        settings: Constants.
        index: Number of critic updates before this one.
        update: From a state to the next one.
        state: The present one.
    """
    if settings.policy_delay == 1:
        return update(state)
    return jax.lax.cond(index % settings.policy_delay == 0, update, lambda state: state, state)


def update_targets(state: State, names: Sequence[str], tau: float) -> State:
    """Move the target of each named network a fraction tau towards it."""
    return state | {
        f"{name}_target": optax.incremental_update(state[name], state[f"{name}_target"], tau)
        for name in names
    }


def adam_step(state: State, name: str, gradient: Params | Array, learning_rate: float) -> State:
    """Take one step of Adam with one entry of the state."""
    optimizer = f"{name}_optimizer"
    step, moments = optax.adam(learning_rate).update(gradient, state[optimizer])
    return state | {name: optax.apply_updates(state[name], step), optimizer: moments}


def squared_error(
    critic: Params, batch: Batch, targets: Array, precision: str
) -> tuple[Array, Array]:
    """Return the sum over the critics of E[(Q_i(s, a) - y)^2], and their values.

    Shapes:
        targets: ``(batch,)``; values: ``(n_critics, batch)``.
    """
    q = q_values(critic, batch.observations, batch.actions, precision)
    return jnp.square(q - targets).mean(axis=1).sum(), q


def q_values(critic: Params, observations: Array, actions: Array, precision: str) -> Array:
    """Return the value that each critic gives to each pair. Shapes: ``(n_critics, batch)``."""
    inputs = jnp.concatenate([observations, actions], axis=-1)
    return forward(critic, inputs, precision=precision)[..., 0]
