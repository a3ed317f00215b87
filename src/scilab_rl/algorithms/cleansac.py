"""Soft actor-critic (SAC) in one file, with optional hindsight experience replay (HER).

Haarnoja et al., 2018, "Soft Actor-Critic Algorithms and Applications", arXiv 1812.05905; HER:
Andrychowicz et al., 2017, arXiv 1707.01495. The agent maximises reward plus entropy,
E[sum_t gamma^t (r_t + alpha H(pi(.|s_t)))]. An update takes a batch (s, a, r, s', d) from the
replay buffer and does, in this order:

    temperature  J(alpha) = E[-log alpha (log pi(a~|s) + H_target)]                       (eq. 18)
    target       y = r + gamma (1 - d) (min_i Q'_i(s', a') - alpha log pi(a'|s'))           (eq. 3)
    critics      J(Q_i) = E[1/2 (Q_i(s, a) - y)^2]                                          (eq. 5)
    actor        J(pi) = E[alpha log pi(a~|s) - min_i Q_i(s, a~)]                            (eq. 9)
    targets      Q'_i <- tau Q_i + (1 - tau) Q'_i

where a~ = tanh(mu(s) + sigma(s) eps) and a' are fresh actions of the policy.

What differs from the paper: any number of critics (``n_critics``), computed as one batched matrix
product; log alpha is learned instead of alpha, as in the authors' code.

Metrics: train/critic_loss, train/actor_loss, train/ent_coef, train/ent_coef_loss,
train/critic_variance (over the target critics), and per environment step train/rollout_q_step,
train/rollout_logpi_step and, on demand, train/rollout_obs_step_<i>, train/rollout_act_step_<i>.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from scilab_rl.algorithms.base import LazyNumber, Observation, OneFileAlgorithm
from scilab_rl.algorithms.intrinsic.build import make_intrinsic_reward

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
Autocast = Callable[[], AbstractContextManager[Any]]


class Actor(nn.Module):
    """The policy: a normal distribution whose samples are squashed into [-scale, scale].

    Args:
        n_observations: Length of an observation.
        n_actions: Dimensions of an action.
        net_arch: Sizes of the hidden layers.
        scale: Largest action.
        autocast: Opens a context for the matrix products, see `autocast_to`.

    Shapes:
        observations: ``(batch, n_observations)``; actions: ``(batch, n_actions)``.
    """

    def __init__(
        self,
        n_observations: int,
        n_actions: int,
        net_arch: Sequence[int],
        scale: float,
        autocast: Autocast = nullcontext,
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for n_in, n_out in itertools.pairwise([n_observations, *net_arch]):
            layers += [nn.Linear(n_in, n_out), nn.ReLU()]
        self.net = nn.Sequential(*layers, nn.Linear([n_observations, *net_arch][-1], 2 * n_actions))
        self.scale = scale
        self.autocast = autocast

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and logarithm of the standard deviation, before squashing."""
        with self.autocast():
            parameters = self.net(observations)
        mean, log_std = parameters.float().chunk(2, dim=-1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def sample(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Draw actions that gradients can flow through; return them and their log probabilities."""
        mean, log_std = self(observations)
        noise = torch.randn_like(mean)
        unsquashed = mean + log_std.exp() * noise
        log_prob = squashed_log_prob(noise, log_std, unsquashed, self.scale)
        return self.scale * torch.tanh(unsquashed), log_prob

    def log_prob(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return the log probability density of given actions."""
        mean, log_std = self(observations)
        unsquashed = torch.atanh((actions / self.scale).clamp(-1 + 1e-6, 1 - 1e-6))
        return squashed_log_prob(
            (unsquashed - mean) / log_std.exp(), log_std, unsquashed, self.scale
        )

    def mean_action(self, observations: Tensor) -> Tensor:
        """Return the squashed mean, the action that is taken without exploration."""
        return self.scale * torch.tanh(self(observations)[0])


class Critics(nn.Module):
    """``n_critics`` independent action-value functions, all in one batched matrix product.

    Shapes:
        observations: ``(batch, n_observations)``; actions: ``(batch, n_actions)``;
        result: ``(batch, n_critics)``; weights: ``(n_critics, n_in, n_out)``.
    """

    def __init__(
        self,
        n_observations: int,
        n_actions: int,
        net_arch: Sequence[int],
        n_critics: int,
        autocast: Autocast = nullcontext,
    ) -> None:
        super().__init__()
        self.autocast = autocast
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for n_in, n_out in itertools.pairwise([n_observations + n_actions, *net_arch, 1]):
            bound = 1 / math.sqrt(n_in)  # the initialisation of torch.nn.Linear
            self.weights.append(torch.empty(n_critics, n_in, n_out).uniform_(-bound, bound))
            self.biases.append(torch.empty(n_critics, 1, n_out).uniform_(-bound, bound))

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return the value that each critic gives to each pair."""
        inputs = torch.cat([observations, actions], dim=1)
        hidden = inputs.expand(len(self.weights[0]), *inputs.shape)
        *hidden_layers, (last_weight, last_bias) = zip(self.weights, self.biases, strict=True)
        with self.autocast():
            for weight, bias in hidden_layers:
                hidden = F.relu_(torch.baddbmm(bias, hidden, weight))
        # The last layer has one output: a sum is faster than a matrix product of one column.
        return ((hidden * last_weight.mT).sum(dim=-1) + last_bias.squeeze(-1)).T


class CLEANSAC(OneFileAlgorithm):
    """Soft actor-critic.

    Args:
        env: Vector environment with continuous actions.
        learning_rate: Of actor, critics and temperature.
        buffer_size: Transitions that the replay buffer holds.
        learning_starts: Environment steps with random actions before the first update.
        batch_size: Transitions per update.
        tau: How far the target critics follow in each update.
        gamma: Discount factor.
        train_freq: Steps of each environment between rounds of updates.
        gradient_steps: Updates per round; -1: as many as steps were collected.
        ent_coef: Weight alpha of the entropy: a number, ``auto`` (learned) or ``auto_0.1``
            (learned, from that initial value).
        target_entropy: Entropy that a learned alpha aims at; ``auto``: -n_actions.
        n_critics: Number of critics.
        ignore_dones_for_qvalue: Whether values continue beyond the end of an episode.
        action_scale_factor: Fraction of the action range that is used.
        log_obs_step: Whether each dimension of the observation is recorded at each step.
        log_act_step: The same for actions.
        net_arch: Sizes of the hidden layers of actor and critics.
        precision: ``float32`` or ``bfloat16``, of the matrix products.
        replay_buffer_class: None: a plain replay buffer.
        replay_buffer_kwargs: Further arguments of the replay buffer.
        intrinsic: A reward that the agent gives itself, mixed into the environment's; see
            `scilab_rl.algorithms.intrinsic`. None: none.
        seed, device: See `OneFileAlgorithm`.
    """

    supported_action_spaces = (spaces.Box,)

    def __init__(
        self,
        *,
        env: VecEnv,
        learning_rate: float = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int = 1,
        gradient_steps: int = 1,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        n_critics: int = 2,
        ignore_dones_for_qvalue: bool = False,
        action_scale_factor: float = 1.0,
        log_obs_step: bool = False,
        log_act_step: bool = False,
        net_arch: Sequence[int] = (256, 256),
        precision: str = "float32",
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        intrinsic: str | Mapping[str, Any] | None = None,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        super().__init__(env=env, seed=seed, device=device)
        self.learning_rate = learning_rate
        self.learning_starts = learning_starts
        self.batch_size = batch_size
        self.tau = tau
        self.gamma = gamma
        self.train_freq = train_freq
        self.gradient_steps = gradient_steps
        self.ignore_dones_for_qvalue = ignore_dones_for_qvalue
        self.action_scale_factor = action_scale_factor
        self.log_obs_step = log_obs_step
        self.log_act_step = log_act_step

        sizes = (self.n_observations, self.n_actions, net_arch)
        autocast = autocast_to(precision, self.device)
        self.actor = Actor(*sizes, action_scale_factor, autocast).to(self.device)
        self.critic = Critics(*sizes, n_critics, autocast).to(self.device)
        self.critic_target = copy.deepcopy(self.critic).requires_grad_(False)
        adam = partial(torch.optim.Adam, lr=learning_rate, fused=True)
        self.actor_optimizer = adam(self.actor.parameters())
        self.critic_optimizer = adam(self.critic.parameters())

        self.learns_ent_coef, initial = parse_ent_coef(ent_coef)
        self.ent_coef = torch.tensor(initial, device=self.device)
        self.target_entropy = -float(self.n_actions)
        if target_entropy != "auto":
            self.target_entropy = float(target_entropy)
        if self.learns_ent_coef:
            self.log_ent_coef = self.ent_coef.log().requires_grad_(True)
            self.ent_coef_optimizer = adam([self.log_ent_coef])

        self.replay_buffer = self.make_replay_buffer(
            buffer_size, replay_buffer_class, replay_buffer_kwargs
        )
        self.intrinsic = make_intrinsic_reward(intrinsic, self)

    def iterate(self, callback: BaseCallback) -> bool:
        """Collect ``train_freq`` steps of each environment, then update."""
        if not self.collect(callback):
            return False
        if self.num_timesteps > self.learning_starts:
            as_collected = self.train_freq * self.n_envs
            self.train(self.gradient_steps if self.gradient_steps >= 0 else as_collected)
        return True

    def collect(self, callback: BaseCallback) -> bool:
        """Act and store what happens; return False when the callback wants to stop."""
        callback.on_rollout_start()
        for _ in range(self.train_freq):
            actions = self.explore()
            env_actions = self.to_env_actions(actions)
            self._record_step(self._last_obs, env_actions)
            step = self.step(env_actions, callback)
            if step is None:
                return False
            self.store(step, actions.cpu().numpy())
        callback.on_rollout_end()
        return True

    def explore(self) -> Tensor:
        """Choose the actions for the next step: random ones at first, then the policy's."""
        if self.num_timesteps < self.learning_starts:
            random_actions = self.from_env_actions(self.sample_env_actions())
            return torch.as_tensor(random_actions) * self.action_scale_factor
        with torch.no_grad():
            return self.act(self.to_vector(self._last_obs), deterministic=False)

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1]."""
        if deterministic:
            return self.actor.mean_action(observations)
        return self.actor.sample(observations)[0]

    def train(self, gradient_steps: int) -> None:
        """Update temperature, critics, actor and target critics, in this order."""
        losses: dict[str, list[Tensor]] = defaultdict(list)
        for _ in range(gradient_steps):
            batch = self.sample(self.batch_size)
            if self.intrinsic is not None:
                batch = self.intrinsic.add_to(batch)
            actions, log_prob = self.actor.sample(batch.observations)

            if self.learns_ent_coef:
                self.ent_coef = self.log_ent_coef.detach().exp()
                loss = temperature_loss(self.log_ent_coef, log_prob.detach(), self.target_entropy)
                losses["ent_coef_loss"].append(descend(self.ent_coef_optimizer, loss))

            targets = self.compute_targets(batch)
            loss = critic_loss(self.critic(batch.observations, batch.actions), targets)
            losses["critic_loss"].append(descend(self.critic_optimizer, loss))

            loss = actor_loss(log_prob, self.critic(batch.observations, actions), self.ent_coef)
            losses["actor_loss"].append(descend(self.actor_optimizer, loss))

            follow(self.critic_target, self.critic, self.tau)
            self.n_updates += 1
        self.record_losses(losses)
        self.logger.record("train/ent_coef", self.ent_coef)

    @torch.no_grad()
    def compute_targets(self, batch: Any) -> Tensor:
        """Return what the critics should say, y. Shapes: ``(batch, 1)``."""
        next_actions, next_log_prob = self.actor.sample(batch.next_observations)
        next_q = self.critic_target(batch.next_observations, next_actions)
        self.logger.record("train/critic_variance", critic_variance(next_q).mean())
        dones = torch.zeros_like(batch.dones) if self.ignore_dones_for_qvalue else batch.dones
        return soft_target(batch.rewards, dones, next_q, next_log_prob, self.ent_coef, self.gamma)

    def _record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        """Record what the agent of the first environment sees, does and thinks of it."""
        q = LazyNumber(lambda: self.q_values(observations, env_actions)[0].min())
        self.logger.record("train/rollout_q_step", q)
        logpi = LazyNumber(lambda: self.log_prob(observations, env_actions)[0])
        self.logger.record("train/rollout_logpi_step", logpi)
        if self.log_obs_step:
            self.record_dimensions("train/rollout_obs_step", self.to_vector(observations)[0])
        if self.log_act_step:
            self.record_dimensions("train/rollout_act_step", env_actions[0])

    @torch.no_grad()
    def q_values(self, observations: Observation, env_actions: np.ndarray) -> Tensor:
        """Return what each critic thinks of a batch of steps. Shapes: ``(batch, n_critics)``."""
        actions = torch.as_tensor(self.from_env_actions(env_actions), device=self.device)
        return self.critic(self.to_vector(observations), actions)

    @torch.no_grad()
    def log_prob(self, observations: Observation, env_actions: np.ndarray) -> Tensor:
        """Return the log density of actions scaled to [-1, 1]. Shapes: ``(batch,)``."""
        actions = torch.as_tensor(self.from_env_actions(env_actions), device=self.device)
        return self.actor.log_prob(self.to_vector(observations), actions).squeeze(1)


def squashed_log_prob(noise: Tensor, log_std: Tensor, unsquashed: Tensor, scale: float) -> Tensor:
    """Return log pi(a|s) of a = scale tanh(u), u = mu + sigma eps (appendix C, eq. 26).

    log pi = sum_j log N(eps_j; 0, 1) - log sigma_j - log(scale (1 - tanh(u_j)^2)), with
    log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)), which cannot overflow.

    Shapes:
        noise, log_std, unsquashed: ``(batch, n_actions)``; result: ``(batch, 1)``.
    """
    normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    squashing = 2 * (math.log(2) - unsquashed - F.softplus(-2 * unsquashed)) + math.log(scale)
    return (normal - squashing).sum(dim=-1, keepdim=True)


def temperature_loss(log_ent_coef: Tensor, log_prob: Tensor, target_entropy: float) -> Tensor:
    """Return J(alpha) (eq. 18), with log alpha in the place of alpha.

    Shapes:
        log_prob: ``(batch, 1)``; result: scalar.
    """
    return -(log_ent_coef * (log_prob + target_entropy)).mean()


def soft_target(
    rewards: Tensor,
    dones: Tensor,
    next_q: Tensor,
    next_log_prob: Tensor,
    ent_coef: Tensor | float,
    gamma: float,
) -> Tensor:
    """Return y, the soft Bellman backup (eq. 3).

    Shapes:
        next_q: ``(batch, n_critics)``; all others and the result: ``(batch, 1)``.
    """
    next_value = next_q.amin(dim=1, keepdim=True) - ent_coef * next_log_prob
    return rewards + gamma * (1 - dones) * next_value


def critic_loss(q_values: Tensor, targets: Tensor) -> Tensor:
    """Return the sum of J(Q_i) over the critics (eq. 5).

    Shapes:
        q_values: ``(batch, n_critics)``; targets: ``(batch, 1)``; result: scalar.
    """
    return 0.5 * (q_values - targets).square().mean(dim=0).sum()


def actor_loss(log_prob: Tensor, q_values: Tensor, ent_coef: Tensor | float) -> Tensor:
    """Return J(pi) (eq. 9).

    Shapes:
        log_prob: ``(batch, 1)``; q_values: ``(batch, n_critics)``; result: scalar.
    """
    return (ent_coef * log_prob - q_values.amin(dim=1, keepdim=True)).mean()


def critic_variance(q_values: Tensor) -> Tensor:
    """Return how much the critics disagree: the mean squared deviation from their mean.

    Shapes:
        q_values: ``(batch, n_critics)``; result: ``(batch, 1)``.
    """
    return q_values.var(dim=1, correction=0, keepdim=True)


def descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> Tensor:
    """Take one step down the gradient, of the optimizer's own parameters only; return the loss."""
    optimizer.zero_grad()
    loss.backward(inputs=[p for group in optimizer.param_groups for p in group["params"]])
    optimizer.step()
    return loss.detach()


@torch.no_grad()
def follow(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move the target network a fraction tau towards the learned one."""
    for slow, fast in zip(target.parameters(), source.parameters(), strict=True):
        slow.lerp_(fast, tau)


def autocast_to(precision: str, device: torch.device) -> Autocast:
    """Return what opens a context whose matrix products have this precision.

    Weights, gradients of weights, losses and everything outside of the context stay float32.
    """
    if precision == "float32":
        return nullcontext
    if precision != "bfloat16":
        raise ValueError(f"precision must be float32 or bfloat16, but it is {precision!r}")
    return partial(torch.autocast, device.type, torch.bfloat16)


def parse_ent_coef(ent_coef: str | float) -> tuple[bool, float]:
    """Return whether alpha is learned, and its initial or fixed value.

    >>> parse_ent_coef("auto"), parse_ent_coef("auto_0.1"), parse_ent_coef(0.2)
    ((True, 1.0), (True, 0.1), (False, 0.2))
    """
    word, _, initial = str(ent_coef).partition("_")
    learned = word == "auto"
    try:
        value = float(initial or 1.0) if learned else float(ent_coef)
    except ValueError:
        value = math.nan
    if not (value > 0 if learned else value >= 0):
        raise ValueError(f"ent_coef must be auto, auto_0.1 or a number, but it is {ent_coef!r}")
    return learned, value
