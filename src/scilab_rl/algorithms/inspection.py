"""Asking any algorithm what it thinks of a step, without changing what it does next.

One adapter for Stable-Baselines3, sb3_contrib, our one-file algorithms and those of the desk. An
algorithm's own methods ``q_values(observations, actions)``, ``log_prob(observations, actions)``,
``entropy(observations)``, ``value(observations)`` and ``intrinsic_reward(observations, actions,
next_observations)`` are asked first; they get batches as the vector environment gives them and
answer with one row per entry. Otherwise the networks of Stable-Baselines3's policies are asked.
"""

from __future__ import annotations

import ast
import contextlib
import inspect
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from scilab_rl.algorithms.compatibility import is_goal_space

Q_VALUES, VALUE, LOG_PROB, ENTROPY = "q_values", "value", "log_prob", "entropy"
INTRINSIC_REWARD, GOALS = "intrinsic_reward", "goals"
N_ENTROPY_SAMPLES = 128
_RECORDING = ("record", "record_mean", "record_lazy")

Batch = Any  # observations of a vector environment: an array, or a dictionary of arrays


class Inspection:
    """Answers questions about single steps.

    Observations and actions are those of the environment; normalisation and scaling are done here.

    Args:
        algorithm: Anything with ``predict``, ``observation_space`` and ``get_env``.

    Attributes:
        algorithm: The algorithm.
        quantities: What it can be asked: ``q_values``, ``value``, ``log_prob``, ``entropy``,
            ``intrinsic_reward``, and ``goals`` when its observations carry goals.
    """

    def __init__(self, algorithm: Any) -> None:
        self.algorithm = algorithm
        self._normalization = unwrap_vec_normalize(algorithm.get_env())
        self._ask = _methods(algorithm)
        self.quantities = frozenset(self._ask) | _derived(algorithm, set(self._ask))

    @property
    def gamma(self) -> float:
        """The discount factor; 1 for algorithms without one."""
        return float(getattr(self.algorithm, "gamma", 1.0))

    def q_values(self, observation: Any, action: Any) -> np.ndarray:
        """Return what each critic says about an action. Shapes: result ``(n_critics,)``."""
        return self._q_values(self._batch(observation), np.asarray(action)[None])[0]

    def value(self, observation: Any) -> float:
        """Return the value of an observation.

        That is the value network's answer; for algorithms with action values the mean over the
        critics of Q(s, pi(s)), with the policy's most likely action pi(s).
        """
        batch = self._batch(observation)
        if VALUE in self._ask:
            return float(_numbers(self._ask[VALUE](batch)).item())
        action, _ = self.algorithm.predict(batch, deterministic=True)
        return float(self._q_values(batch, action)[0].mean())

    def log_prob(self, observation: Any, action: Any) -> float:
        """Return log pi(a|s), a density in the algorithm's own units of actions."""
        answer = self._ask[LOG_PROB](self._batch(observation), np.asarray(action)[None])
        return float(_numbers(answer).item())

    def entropy(self, observation: Any) -> float:
        """Return the entropy of the policy in nats.

        Where there is no closed form it is the mean of -log pi(a|s) over 128 samples, always from
        the same random numbers, so that the curve over an episode is smooth.
        """
        if ENTROPY in self._ask:
            return float(_numbers(self._ask[ENTROPY](self._batch(observation))).item())
        batch = _repeat(self._batch(observation), N_ENTROPY_SAMPLES)
        torch.manual_seed(0)  # `undisturbed` puts the generators back
        actions, _ = self.algorithm.predict(batch, deterministic=False)
        return float(-_numbers(self._ask[LOG_PROB](batch, actions)).mean())

    def intrinsic_reward(self, observation: Any, action: Any, next_observation: Any) -> float:
        """Return the reward that the algorithm gives itself for a step."""
        answer = self._ask[INTRINSIC_REWARD](
            self._batch(observation), np.asarray(action)[None], self._batch(next_observation)
        )
        return float(_numbers(answer).item())

    def intrinsic_rewards(
        self, observations: Batch, actions: np.ndarray, next_observations: Batch
    ) -> np.ndarray:
        """Return the rewards that the algorithm gives itself for a step of each environment.

        Shapes:
            all entries: ``(n_envs, ...)``; result: ``(n_envs,)``.
        """
        with self.undisturbed():
            answer = self._ask[INTRINSIC_REWARD](
                self._normalized(observations), actions, self._normalized(next_observations)
            )
        return _numbers(answer).reshape(-1)

    def learned_reward(self, reward: float) -> float:
        """Return a reward in the scale that the critics learn, which VecNormalize may change."""
        if self._normalization is None:
            return float(reward)
        return float(self._normalization.normalize_reward(np.array([reward]))[0])

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Ask inside of this: random generators and modes are afterwards as before."""
        policy = getattr(self.algorithm, "policy", None)
        was_training = bool(getattr(policy, "training", False))
        numpy_state = np.random.get_state()
        devices = [torch.cuda.current_device()] if torch.cuda.is_initialized() else []
        with torch.random.fork_rng(devices), torch.no_grad():
            if was_training:
                policy.set_training_mode(False)  # type: ignore[union-attr]
            try:
                yield
            finally:
                np.random.set_state(numpy_state)
                if was_training:
                    policy.set_training_mode(True)  # type: ignore[union-attr]

    def _q_values(self, batch: Batch, actions: np.ndarray) -> np.ndarray:
        return _numbers(self._ask[Q_VALUES](batch, actions))

    def _batch(self, observation: Any) -> Batch:
        if isinstance(observation, dict):
            batch: Batch = {key: np.asarray(value)[None] for key, value in observation.items()}
        else:
            batch = np.asarray(observation)[None]
        return self._normalized(batch)

    def _normalized(self, batch: Batch) -> Batch:
        return batch if self._normalization is None else self._normalization.normalize_obs(batch)


def recorded_names(algorithm: Any) -> set[str]:
    """Return the names under which an algorithm records metrics, as its source code says.

    Names that are put together while it runs come as patterns: ``train/rollout_obs_step_*``.
    """
    names = {"train/intrinsic_reward_step"} if INTRINSIC_REWARD in _methods(algorithm) else set()
    intrinsic = type(getattr(algorithm, "intrinsic", None))
    for ancestor in (*type(algorithm).__mro__, *intrinsic.__mro__):
        try:
            source = inspect.getsource(ancestor)
        except (OSError, TypeError):  # built-in classes have no source
            continue
        calls = ast.walk(ast.parse(textwrap.dedent(source)))
        names |= {_recorded_name(node) for node in calls if _is_record_call(node)}
    return {name for name in names if not name.startswith("*")}


def _is_record_call(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in _RECORDING
        and bool(node.args)
    )


def _recorded_name(node: Any) -> str:
    """Return the name in a call of ``record``, with a star for what is put in while it runs."""
    name = node.args[0]
    parts = name.values if isinstance(name, ast.JoinedStr) else [name]
    texts = [part.value if isinstance(part, ast.Constant) else "*" for part in parts]
    return "".join(map(str, texts))


def _methods(algorithm: Any) -> dict[str, Callable[..., Any]]:
    """Return how to ask for each quantity that the algorithm answers directly."""
    asked = _stable_baselines_methods(algorithm)
    for quantity in (Q_VALUES, VALUE, LOG_PROB, ENTROPY, INTRINSIC_REWARD):
        if callable(own := getattr(algorithm, quantity, None)):
            asked[quantity] = own
    if (intrinsic := getattr(algorithm, "intrinsic", None)) is not None:
        asked.setdefault(INTRINSIC_REWARD, intrinsic.of_steps)
    return asked


def _derived(algorithm: Any, asked: set[str]) -> set[str]:
    quantities = set()
    if Q_VALUES in asked:
        quantities.add(VALUE)
    if LOG_PROB in asked:
        quantities.add(ENTROPY)
    if is_goal_space(algorithm.observation_space):
        quantities.add(GOALS)
    return quantities


def _stable_baselines_methods(algorithm: Any) -> dict[str, Callable[..., Any]]:
    policy = getattr(algorithm, "policy", None)
    if policy is None or not callable(getattr(policy, "obs_to_tensor", None)):
        return {}
    networks = _PolicyNetworks(policy)
    if hasattr(policy, "predict_values"):  # PPO, A2C, TRPO
        return {
            VALUE: networks.state_values,
            LOG_PROB: networks.evaluated_log_prob,
            ENTROPY: networks.exact_entropy,
        }
    if hasattr(policy, "q_net") or hasattr(policy, "quantile_net"):  # DQN, QRDQN
        return {Q_VALUES: networks.discrete_q_values}
    if hasattr(policy, "critic"):  # SAC, TD3, DDPG, TQC, CrossQ
        asked: dict[str, Callable[..., Any]] = {Q_VALUES: networks.critic_q_values}
        if hasattr(policy.actor, "get_action_dist_params"):
            asked[LOG_PROB] = networks.actor_log_prob
        return asked
    return {}


class _PolicyNetworks:
    """The networks of one of Stable-Baselines3's policies, asked with batches."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def critic_q_values(self, batch: Batch, actions: np.ndarray) -> torch.Tensor:
        """Return one column per critic; TQC's critics say the mean of their quantiles."""
        answer = self.policy.critic(self._tensor(batch), self._scaled(actions))
        return torch.cat(answer, dim=1) if isinstance(answer, tuple) else answer.mean(dim=2)

    def discrete_q_values(self, batch: Batch, actions: np.ndarray) -> torch.Tensor:
        """Return the value of the chosen actions; QRDQN says the mean of its quantiles."""
        if hasattr(self.policy, "quantile_net"):
            q_values = self.policy.quantile_net(self._tensor(batch)).mean(dim=1)
        else:
            q_values = self.policy.q_net(self._tensor(batch))
        index = torch.as_tensor(np.asarray(actions).reshape(-1, 1), device=q_values.device)
        return q_values.gather(1, index.long())

    def actor_log_prob(self, batch: Batch, actions: np.ndarray) -> torch.Tensor:
        """Return the log density of actions scaled to [-1, 1]."""
        actor = self.policy.actor
        mean, log_std, more = actor.get_action_dist_params(self._tensor(batch))
        return actor.action_dist.proba_distribution(mean, log_std, **more).log_prob(
            self._scaled(actions)
        )

    def state_values(self, batch: Batch) -> torch.Tensor:
        """Return the value network's answer."""
        return self.policy.predict_values(self._tensor(batch))

    def evaluated_log_prob(self, batch: Batch, actions: np.ndarray) -> torch.Tensor:
        """Return the log probability of actions in the environment's units."""
        distribution = self.policy.get_distribution(self._tensor(batch))
        return distribution.log_prob(torch.as_tensor(actions, device=self.policy.device))

    def exact_entropy(self, batch: Batch) -> torch.Tensor:
        """Return the policy's entropy."""
        return self.policy.get_distribution(self._tensor(batch)).entropy()

    def _tensor(self, batch: Batch) -> Any:
        return self.policy.obs_to_tensor(batch)[0]

    def _scaled(self, actions: np.ndarray) -> torch.Tensor:
        scaled = self.policy.scale_action(np.asarray(actions)).reshape(len(actions), -1)
        return torch.as_tensor(scaled, dtype=torch.float32, device=self.policy.device)


def _numbers(answer: Any) -> np.ndarray:
    return np.asarray(answer.detach().cpu() if isinstance(answer, torch.Tensor) else answer)


def _repeat(batch: Batch, n: int) -> Batch:
    if isinstance(batch, dict):
        return {key: np.repeat(value, n, axis=0) for key, value in batch.items()}
    return np.repeat(batch, n, axis=0)
