"""Contrastive goal-conditioned reinforcement learning: goals without rewards, compiled by JAX.

Eysenbach et al., 2022, "Contrastive Learning as Goal-Conditioned Reinforcement Learning", arXiv
2206.07568, in the online form of Bortkiewicz et al., 2024, "Accelerating Goal-Conditioned RL
Algorithms and Research" (JaxGCRL), arXiv 2408.11052. The loop, the policy and its entropy are those
of `jaxsac`; the critic is another one. It has no rewards, no targets and no target networks: it is
a classifier that tells which goal was reached from which step.

    goals    for each step (s_i, a_i) of a batch one goal g_i that was reached k steps later in the
             same episode, k geometric: P(k) ~ gamma^(k-1)                   (2206.07568, section 3)
    critic   similarity f(s, a, g) = -|phi(s, a) - psi(g)|, or phi(s, a) . psi(g)
             L_ij = f(s_i, a_i, g_j): the goal of each step among those of the others
             J(f) = -E[L_ii - lse_j L_ij]  (infonce);  -E[2 L_ii - lse_j L_ij - lse_i L_ij]
             (symmetric);  + penalty E[(lse_j L_ij)^2]            (2408.11052, section 4.2 and A)
    actor    J(pi) = E[alpha log pi(a|s, g) - f(s, a, g)]        (eq. 6, with SAC's entropy)

The best f is log p(g | s, a) / p(g) plus a constant, where p(g | s, a) is the chance to be at g
gamma-soon (2206.07568, lemma 4.1). A goal that is reached surely in k steps has gamma^k times
the density of one that is reached now; that is where ``steps_to_goal`` comes from:

    k = (f(s, a, where s is) - f(s, a, g)) / -log gamma

A goal that is reached only by chance seems farther away than it is: k says at most so many steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from scilab_rl.algorithms.cleansac import parse_ent_coef
from scilab_rl.algorithms.jaxsac import gaussian, sample, squashed_log_prob, temperature_loss
from scilab_rl.envs.types import Observation
from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.learning.base import LazyNumber
from scilab_rl.learning.jax_engine import Array, Batch, Params, State, dense_layers, forward
from scilab_rl.learning.jax_off_policy import (
    JaxOffPolicyAlgorithm,
    Losses,
    UpdateSettings,
    adam_step,
)
from scilab_rl.learning.replay import HindsightReplayBuffer, entry_columns

ENERGIES, LOSSES = ("l2", "dot"), ("symmetric", "infonce")
_SMALLEST = 1e-6  # squared distance: the square root has no derivative at 0
Encoders = dict[str, Params]  # phi: (s, a), and psi: g
_PHI, _PSI = "state_action_encoder", "goal_encoder"


@dataclass(frozen=True)
class Settings(UpdateSettings):
    """The constants of an update, for which it is compiled; see `JAXCRL`.

    Attributes:
        goal: Where the desired goal is in an observation: its first number, and the one after it.
    """

    goal: tuple[int, int]
    energy: str
    loss: str
    logsumexp_penalty: float
    random_goals: float
    learns_ent_coef: bool
    target_entropy: float


class JAXCRL(JaxOffPolicyAlgorithm):
    """Contrastive goal-conditioned reinforcement learning, compiled.

    Args:
        env: Environment with goals; what it pays is not read.
        learning_rate: Of actor, encoders and temperature.
        buffer_size: Transitions that the replay buffer holds.
        learning_starts: Environment steps with random actions before the first update.
        batch_size: Steps per update; each goal is distinguished from those of all others.
        gamma: How far goals are in the future: 1 / (1 - gamma) steps on average.
        train_freq: Steps of each environment between rounds of updates.
        gradient_steps: Updates per round; -1: as many as steps were collected.
        ent_coef: Weight alpha of the entropy: a number, ``auto`` (learned) or ``auto_0.1``
            (learned, from that initial value).
        target_entropy: Entropy that a learned alpha aims at; ``auto``: -n_actions / 2.
        energy: Similarity of two representations: ``l2``, minus their distance, or ``dot``.
        loss: ``symmetric`` or ``infonce``, see above.
        logsumexp_penalty: Weight of the squared log-sum-exp, which keeps similarities of different
            steps in one scale.
        random_goals: Share of the actor's goals that are those of other steps of the batch; the
            others are reached from the step itself.
        representation_size: Length of phi and psi.
        random_actions: Share of uniformly random actions after ``learning_starts``.
        normalize_observations: Whether the networks see observations of unit variance.
        layer_norm: Whether the encoders normalize their hidden layers.
        net_arch: Sizes of the hidden layers of actor and encoders.
        precision: ``float32`` or ``bfloat16``, of the matrix products.
        overlap: Whether the environments step while a round of updates computes.
        replay_buffer_class: Our own hindsight replay, which ``auto`` is.
        replay_buffer_kwargs: Its further arguments, such as ``goal_selection_strategy``.
        seed, device: See `JaxOffPolicyAlgorithm`.
    """

    supported_action_spaces = (spaces.Box,)
    needs_goals = True
    metrics = (
        "train/accuracy",  # how often a step's own goal is the most similar one of the batch
        "train/ent_coef",
        "train/rollout_logpi_step",
        ("train/ent_coef_loss", "ent_coef is auto", lambda self: self.learns_ent_coef),
    )

    def __init__(
        self,
        *,
        env: VecEnv,
        learning_rate: float = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        gamma: float = 0.99,
        train_freq: int = 1,
        gradient_steps: int = -1,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        energy: str = "l2",
        loss: str = "symmetric",
        logsumexp_penalty: float = 0.1,
        random_goals: float = 0.0,
        representation_size: int = 64,
        random_actions: float = 0.0,
        normalize_observations: bool = False,
        layer_norm: bool = False,
        net_arch: Sequence[int] = (256, 256),
        precision: str = "float32",
        overlap: bool = True,
        replay_buffer_class: type[ReplayBuffer] | None = HindsightReplayBuffer,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        _require("energy", energy, ENERGIES)
        _require("loss", loss, LOSSES)
        if not issubclass(replay_buffer_class or ReplayBuffer, HindsightReplayBuffer):
            raise ConfigError(
                "jaxcrl needs our own hindsight replay, whose goals are floating-point arrays; set "
                "++algorithm.replay_buffer_class=auto."
            )
        kwargs = {"goal_selection_strategy": "geometric"} | (replay_buffer_kwargs or {})
        super().__init__(
            env=env, learning_rate=learning_rate, buffer_size=buffer_size,
            learning_starts=learning_starts, batch_size=batch_size, gamma=gamma,
            train_freq=train_freq, gradient_steps=gradient_steps, n_critics=1,
            random_actions=random_actions, normalize_observations=normalize_observations,
            layer_norm=layer_norm, net_arch=net_arch, precision=precision, overlap=overlap,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=kwargs | {"discount": gamma, "goals_only": True},
            seed=seed, device=device,
        )  # fmt: skip
        self.learns_ent_coef, ent_coef = parse_ent_coef(ent_coef)
        assert isinstance(env.observation_space, spaces.Dict)  # the buffer has checked it
        columns = entry_columns(env.observation_space)
        self._goal, self._achieved = columns["desired_goal"], columns["achieved_goal"]
        is_auto = target_entropy == "auto"
        self._energy = energy
        settings = Settings.of(
            self,
            goal=(self._goal.start, self._goal.stop),
            energy=energy,
            loss=loss,
            logsumexp_penalty=logsumexp_penalty,
            random_goals=random_goals,
            learns_ent_coef=self.learns_ent_coef,
            target_entropy=-self.n_actions / 2 if is_auto else float(target_entropy),
        )
        networks = self._draw_networks(representation_size)
        state = initial_state(networks, ent_coef, learning_rate)
        self.start_learning(update, settings, state, shown=("actor", _PHI, _PSI))

    def _draw_networks(self, representation_size: int) -> dict[str, Params]:
        n_goal = self._goal.stop - self._goal.start
        n_state_action = self.n_observations - n_goal + self.n_actions
        ends = (*self.net_arch, representation_size)
        return {
            "actor": dense_layers([self.n_observations, *self.net_arch, 2 * self.n_actions]),
            _PHI: dense_layers([n_state_action, *ends], layer_norm=self.layer_norm),
            _PSI: dense_layers([n_goal, *ends], layer_norm=self.layer_norm),
        }

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1], with the networks of the last finished round."""
        mean, log_std = self._gaussian(observations)
        if not deterministic:
            mean = mean + np.exp(log_std) * np.random.standard_normal(mean.shape)
        return torch.as_tensor(np.tanh(mean), dtype=torch.float32)

    def action_values(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return f(s, a, g): a logarithm, and not a return. Shapes: ``(batch, 1)``."""
        vectors = self.normalizer(observations.numpy())
        similarity = self._similarity(vectors, actions.numpy())
        return torch.as_tensor(np.array(similarity)[:, None], dtype=torch.float32)

    def similarity(self, observations: Observation, env_actions: np.ndarray) -> np.ndarray:
        """Return f(s, a, g) with the desired goal g. Shapes: ``(batch,)``."""
        return self.q_values(observations, env_actions)[:, 0].numpy()

    def steps_to_goal(self, observations: Observation, env_actions: np.ndarray) -> np.ndarray:
        """Return how many steps away the desired goal is thought to be. Shapes: ``(batch,)``."""
        here = self.to_vector(observations).clone()
        here[:, self._goal] = here[:, self._achieved]
        there = self.action_values(here, self.to_actions(env_actions))[:, 0].numpy()
        difference = there - self.similarity(observations, env_actions)
        return np.maximum(difference / -math.log(self.gamma), 0.0)

    def record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        """Record what the agent of the first environment thinks of what it does."""
        super().record_step(observations, env_actions)
        logpi = LazyNumber(lambda: self.log_prob(observations, env_actions)[0])
        self.logger.record("train/rollout_logpi_step", logpi)

    def log_prob(self, observations: Observation, env_actions: np.ndarray) -> np.ndarray:
        """Return the log density of actions scaled to [-1, 1]. Shapes: ``(batch,)``."""
        mean, log_std = self._gaussian(self.to_vector(observations))
        inside = self.from_env_actions(env_actions).clip(-1 + 1e-6, 1 - 1e-6)
        noise = (np.arctanh(inside) - mean) / np.exp(log_std)
        return np.asarray(squashed_log_prob(noise, log_std, np.arctanh(inside), 1.0))

    def _gaussian(self, observations: Tensor) -> tuple[Array, Array]:
        vectors = self.normalizer(observations.numpy())
        return gaussian(forward(self.rounds.networks["actor"], vectors, xp=np))

    def _similarity(self, vectors: np.ndarray, actions: np.ndarray) -> Array:
        states, goals = split_goals(vectors, (self._goal.start, self._goal.stop), np)
        phi, psi = represent(self.rounds.networks, states, actions, goals, xp=np)
        return similarities(self._energy, phi, psi, np)


def initial_state(networks: dict[str, Params], ent_coef: float, learning_rate: float) -> State:
    """Return weights, temperature and moments before the first update."""
    with np.errstate(divide="ignore"):  # a temperature of 0 is minus infinity
        learned = networks | {"log_ent_coef": np.log(np.float32(ent_coef))}
    adam = optax.adam(learning_rate)
    return learned | {f"{name}_optimizer": adam.init(part) for name, part in learned.items()}


def update(
    settings: Settings, state: State, batch: Batch, key: Array, index: Array
) -> tuple[State, Losses]:
    """Update encoders, then actor and temperature; see `UpdateRunner`."""
    encoders = {name: state[name] for name in (_PHI, _PSI)}
    (loss, losses), gradients = jax.value_and_grad(critic_loss, has_aux=True)(
        encoders, settings, batch
    )
    for name, gradient in gradients.items():
        state = adam_step(state, name, gradient, settings.learning_rate)
    losses |= {"critic_loss": loss, "ent_coef": jnp.exp(state["log_ent_coef"])}

    (loss, log_prob), gradient = jax.value_and_grad(actor_loss, has_aux=True)(
        state["actor"], settings, state, batch, key
    )
    state = adam_step(state, "actor", gradient, settings.learning_rate)
    losses["actor_loss"] = loss
    if settings.learns_ent_coef:
        losses["ent_coef_loss"], gradient = jax.value_and_grad(temperature_loss)(
            state["log_ent_coef"], log_prob, settings.target_entropy
        )
        state = adam_step(state, "log_ent_coef", gradient, settings.learning_rate)
    return state, losses


def critic_loss(encoders: Encoders, settings: Settings, batch: Batch) -> tuple[Array, Losses]:
    """Return J(f), and the mean similarity of each step and its own goal, and the accuracy."""
    states, goals = split_goals(batch.observations, settings.goal)
    phi, psi = represent(encoders, states, batch.actions, goals, settings.precision)
    logits = all_similarities(settings.energy, phi, psi)
    loss = contrastive_loss(logits, settings.loss, settings.logsumexp_penalty)
    is_right = logits.argmax(axis=1) == jnp.arange(len(logits))
    return loss, {"q_mean": jnp.diagonal(logits).mean(), "accuracy": is_right.mean()}


def contrastive_loss(logits: Array, kind: str, logsumexp_penalty: float) -> Array:
    """Return how badly each step is matched with its own goal.

    Args:
        logits: L_ij = f(s_i, a_i, g_j). Shapes: ``(batch, batch)``.
        kind: ``infonce``: the goal of each step among all; ``symmetric``: also the step of each
            goal among all.
        logsumexp_penalty: Weight of the squared log-sum-exp over the goals.
    """
    own = jnp.diagonal(logits)
    over_goals = jax.nn.logsumexp(logits, axis=1)
    loss = (over_goals - own).mean()
    if kind == "symmetric":
        loss += (jax.nn.logsumexp(logits, axis=0) - own).mean()
    return loss + logsumexp_penalty * jnp.square(over_goals).mean()


def actor_loss(
    actor: Params, settings: Settings, state: State, batch: Batch, key: Array
) -> tuple[Array, Array]:
    """Return J(pi) and log pi of the sampled actions. Shapes: log pi: ``(batch,)``."""
    states, goals = split_goals(batch.observations, settings.goal)
    n_random = round(settings.random_goals * len(goals))
    goals = jnp.concatenate([jnp.roll(goals, 1, axis=0)[:n_random], goals[n_random:]])
    start, stop = settings.goal
    before, after = batch.observations[:, :start], batch.observations[:, stop:]
    observations = jnp.concatenate([before, goals, after], axis=1)
    actions, log_prob = sample(actor, observations, key, 1.0, settings.precision)
    phi, psi = represent(state, states, actions, goals, settings.precision)
    similarity = similarities(settings.energy, phi, psi)
    return (jnp.exp(state["log_ent_coef"]) * log_prob - similarity).mean(), log_prob


def split_goals(
    observations: Array, goal: tuple[int, int], xp: ModuleType = jnp
) -> tuple[Array, Array]:
    """Divide observations into what is without the desired goal, and the desired goal."""
    start, stop = goal
    before, after = observations[:, :start], observations[:, stop:]
    return xp.concatenate([before, after], axis=1), observations[:, start:stop]


def represent(
    encoders: Encoders,
    states: Array,
    actions: Array,
    goals: Array,
    precision: str = "float32",
    xp: ModuleType = jnp,
) -> tuple[Array, Array]:
    """Return phi(s, a) and psi(g). Shapes: ``(batch, representation_size)``."""
    inputs = xp.concatenate([states, actions], axis=1)
    phi = forward(encoders[_PHI], inputs, xp=xp, precision=precision)
    return phi, forward(encoders[_PSI], goals, xp=xp, precision=precision)


def similarities(energy: str, phi: Array, psi: Array, xp: ModuleType = jnp) -> Array:
    """Return f of each step and the goal in the same row. Shapes: ``(batch,)``."""
    if energy == "dot":
        return (phi * psi).sum(axis=-1)
    return -xp.sqrt(xp.square(phi - psi).sum(axis=-1) + _SMALLEST)


def all_similarities(energy: str, phi: Array, psi: Array) -> Array:
    """Return L, f of each step and each goal, as one matrix product. Shapes: ``(batch, batch)``."""
    products = phi @ psi.T
    if energy == "dot":
        return products
    squares = jnp.square(phi).sum(axis=1)[:, None] + jnp.square(psi).sum(axis=1) - 2 * products
    return -jnp.sqrt(jnp.maximum(squares, 0.0) + _SMALLEST)


def _require(name: str, given: str, allowed: Sequence[str]) -> None:
    if given not in allowed:
        raise ConfigError(
            f"algorithm.{name} must be {' or '.join(allowed)}, but it is {given!r}."
            f"{did_you_mean(str(given), allowed)}"
        )
