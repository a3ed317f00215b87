"""Asking any algorithm what it thinks of a step, without changing what it does next.

One adapter for Stable-Baselines3, sb3_contrib, our one-file algorithms and those of the project
folder. An algorithm's own methods ``q_values(observations, actions)``, ``log_prob(observations,
actions)``, ``entropy(observations)``, ``value(observations)``, ``similarity(observations,
actions)``, ``steps_to_goal(observations, actions)`` and ``intrinsic_reward(observations, actions,
next_observations)`` are asked first; they get batches as the vector environment gives them
and answer with one row per entry. Otherwise the networks of Stable-Baselines3's policies are asked.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    unwrap_vec_normalize,
)

from scilab_rl.canonical_spaces import CanonicalVecEnv, conversions
from scilab_rl.envs.vec_step import Observation
from scilab_rl.errors import ConfigError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.compatibility import is_goal_space
from scilab_rl.learning.observations import Tensors, batch_of_one
from scilab_rl.metrics.probes import SECOND_CRITIC

Q_VALUES, VALUE, LOG_PROB, ENTROPY = "q_values", "value", "log_prob", "entropy"
SIMILARITY, STEPS_TO_GOAL = "similarity", "steps_to_goal"
INTRINSIC_REWARD, GOALS = "intrinsic_reward", "goals"
N_ENTROPY_SAMPLES = 128
_OWN_METHODS = (
    Q_VALUES, VALUE, LOG_PROB, ENTROPY, INTRINSIC_REWARD, SIMILARITY, STEPS_TO_GOAL,
)  # fmt: skip

Answer = np.ndarray | torch.Tensor
# Vector wrappers whose observations are a function of the present ones alone, and that function.
_FUNCTIONS: dict[type, Callable[[Any], Callable[[Observation], Observation]]] = {
    CanonicalVecEnv: lambda layer: layer.observations.from_env,
    VecNormalize: lambda layer: layer.normalize_obs,
    VecTransposeImage: lambda layer: layer.transpose_observations,
    VecExtractDictObs: lambda layer: lambda batch: batch[layer.key],
}
_NO_CHANGE = (VecMonitor, VecCheckNan)


class AgentInspector:
    """Answers questions about single steps.

    Observations and actions are those of the environment; normalization and scaling are done here.
    Where a vector wrapper makes observations that cannot be recomputed from one of the environment,
    such as a stack of frames, nothing that depends on them can be asked.

    Args:
        algorithm: Anything with ``predict``, ``observation_space`` and ``get_env``.

    Attributes:
        algorithm: The algorithm.
        quantities: What it can be asked: ``q_values``, ``value``, ``log_prob``, ``entropy``,
            ``intrinsic_reward``, ``goals`` when its observations carry goals, and
            ``second critic`` when there is more than one critic.
        reason: Why it cannot be asked more, as a sentence; empty where nothing hinders.
    """

    def __init__(self, algorithm: Algorithm) -> None:
        self.algorithm = algorithm
        self._normalization = unwrap_vec_normalize(algorithm.get_env())
        self._actions, _ = conversions(algorithm.get_env())
        self._functions = observation_functions(algorithm.get_env())
        self.reason = why_not_asked(algorithm.get_env())
        self._ask = {} if self.reason else _methods(algorithm)
        self._memory = None if self.reason else _memory_of(algorithm)
        self.quantities = frozenset(self._ask) | _derived(algorithm, set(self._ask))
        if Q_VALUES in self._ask and self._count_critics() > 1:
            self.quantities |= {SECOND_CRITIC}

    @property
    def gamma(self) -> float:
        """The discount factor; 1 for algorithms without one."""
        return float(getattr(self.algorithm, "gamma", 1.0))

    def q_values(self, observation: Observation, action: npt.ArrayLike) -> np.ndarray:
        """Return what each critic says about an action. Shapes: result ``(n_critics,)``."""
        return self._q_values(self._batch(observation), self._action(action))[0]

    def q_values_of_batch(self, observations: Observation, actions: np.ndarray) -> np.ndarray:
        """Return what each critic says about each action. Shapes: result ``(batch, n_critics)``."""
        return self._q_values(self.normalized(observations), self._actions.from_env(actions))

    def value(self, observation: Observation) -> float:
        """Return the value of an observation.

        That is the value network's answer; for algorithms with action values the mean over the
        critics of Q(s, pi(s)), with the policy's most likely action pi(s).
        """
        return float(self._values(self._batch(observation)).item())

    def values(self, observations: Observation) -> np.ndarray:
        """Return the `value` of each observation of a batch.

        Shapes:
            observations: ``(batch, ...)`` per entry; result: ``(batch,)``.
        """
        with self.undisturbed():
            return self._values(self.normalized(observations))

    def log_prob(self, observation: Observation, action: npt.ArrayLike) -> float:
        """Return log pi(a|s), a density in the algorithm's own units of actions."""
        return self._of_step(LOG_PROB, observation, action)

    def similarity(self, observation: Observation, action: npt.ArrayLike) -> float:
        """Return how similar a step and the desired goal are, f(s, a, g) of `jaxcrl`."""
        return self._of_step(SIMILARITY, observation, action)

    def steps_to_goal(self, observation: Observation, action: npt.ArrayLike) -> float:
        """Return how many steps away the algorithm thinks that the desired goal is."""
        return self._of_step(STEPS_TO_GOAL, observation, action)

    def entropy(self, observation: Observation) -> float:
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

    def intrinsic_reward(
        self, observation: Observation, action: npt.ArrayLike, next_observation: Observation
    ) -> float:
        """Return the reward that the algorithm gives itself for a step."""
        answer = self._ask[INTRINSIC_REWARD](
            self._batch(observation), self._action(action), self._batch(next_observation)
        )
        return float(_numbers(answer).item())

    def intrinsic_rewards(
        self, observations: Observation, actions: np.ndarray, next_observations: Observation
    ) -> np.ndarray:
        """Return the rewards that the algorithm gives itself for a step of each environment.

        Shapes:
            all entries: ``(n_envs, ...)``; result: ``(n_envs,)``.
        """
        with self.undisturbed():
            answer = self._ask[INTRINSIC_REWARD](
                self.normalized(observations),
                self._actions.from_env(actions),
                self.normalized(next_observations),
            )
        return _numbers(answer).reshape(-1)

    def act(self, observations: Observation, *, deterministic: bool) -> np.ndarray:
        """Return what the policy does in each observation of a batch, in the environment's units.

        Args:
            observations: As the environments give them. Shapes: ``(batch, ...)`` per entry.
            deterministic: Whether the most likely action is taken.

        Raises:
            ConfigError: If the policy remembers earlier steps, or sees what cannot be recomputed.
        """
        if self.reason:
            raise ConfigError(self.reason)
        batch = self.normalized(observations)
        actions, memory = self.algorithm.predict(batch, deterministic=deterministic)
        if memory is not None:
            raise ConfigError(
                f"{type(self.algorithm).__name__} remembers earlier steps, so that it cannot be "
                "asked about a single scene."
            )
        return np.asarray(self._actions.to_env(actions))

    def learned_reward(self, reward: float) -> float:
        """Return a reward in the scale that the critics learn, which VecNormalize may change."""
        if self._normalization is None:
            return float(reward)
        return float(self._normalization.normalize_reward(np.array([reward]))[0])

    @property
    def has_memory(self) -> bool:
        """Whether what the policy does depends on earlier observations."""
        return self._memory is not None

    def after(self, observation: Observation) -> AgentInspector:
        """Return the inspector of the next step, which remembers an observation if policies do.

        A new inspector remembers nothing: its first observation begins an episode.
        """
        if self._memory is None:
            return self
        later = copy.copy(self)
        later._memory = self._memory.after(self._batch(observation))
        later._ask = self._ask | later._memory.methods()
        return later

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

    def _count_critics(self) -> int:
        """Ask about any step how many critics answer, in the algorithm's own spaces."""
        observation = _example(self.algorithm.observation_space)
        action = np.asarray(_example(self.algorithm.action_space))
        with self.undisturbed():
            return self._q_values(batch_of_one(observation), action[None]).shape[1]

    def _of_step(self, quantity: str, observation: Observation, action: npt.ArrayLike) -> float:
        answer = self._ask[quantity](self._batch(observation), self._action(action))
        return float(_numbers(answer).item())

    def _q_values(self, batch: Observation, actions: np.ndarray) -> np.ndarray:
        return _numbers(self._ask[Q_VALUES](batch, actions))

    def _values(self, batch: Observation) -> np.ndarray:
        if VALUE in self._ask:
            return _numbers(self._ask[VALUE](batch)).reshape(-1)
        actions, _ = self.algorithm.predict(batch, deterministic=True)
        return self._q_values(batch, actions).mean(axis=1)

    def _batch(self, observation: Observation) -> Observation:
        return self.normalized(batch_of_one(observation))

    def _action(self, action: npt.ArrayLike) -> np.ndarray:
        return self._actions.from_env(np.asarray(action)[None])

    def normalized(self, batch: Observation) -> Observation:
        """Return a batch of the environment's observations as the algorithm reads it."""
        for function in self._functions:
            batch = function(batch)
        return batch


def why_not_asked(env: VecEnv | None) -> str:
    """Say which vector wrapper hides from the environment's observations what the agent sees.

    Returns:
        A sentence, or nothing where all can be recomputed.
    """
    for layer in _layers(env):
        is_ours = type(layer).__module__.startswith("scilab_rl.")
        if not is_ours and not isinstance(layer, (*_FUNCTIONS, *_NO_CHANGE)):
            return (
                f"What the agent sees cannot be recomputed below the vector wrapper "
                f"{type(layer).__name__}; a gymnasium.Wrapper, which wraps each environment, such "
                "as gymnasium.wrappers.FrameStackObservation, has no such limit."
            )
    return ""


def _layers(env: VecEnv | None) -> Iterator[VecEnvWrapper]:
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


def observation_functions(env: VecEnv | None) -> list[Callable[[Observation], Observation]]:
    """Return what turns the environment's observations into the algorithm's, in order."""
    return [
        make(layer)
        for layer in reversed(list(_layers(env)))
        for kind, make in _FUNCTIONS.items()
        if isinstance(layer, kind)
    ]


def quantities_asked_directly(algorithm: object) -> frozenset[str]:
    """Return the quantities for which an algorithm or its policy has a method."""
    return frozenset(_methods(algorithm))


def _methods(algorithm: object) -> dict[str, Callable[..., Answer]]:
    """Return how to ask for each quantity that the algorithm answers directly."""
    asked = _stable_baselines_methods(algorithm)
    for quantity in _OWN_METHODS:
        if callable(own := getattr(algorithm, quantity, None)):
            asked[quantity] = own
    if (intrinsic := getattr(algorithm, "intrinsic", None)) is not None:
        asked.setdefault(INTRINSIC_REWARD, intrinsic.evaluate)
    return asked


def _derived(algorithm: Algorithm, asked: set[str]) -> set[str]:
    quantities = set()
    if Q_VALUES in asked and SIMILARITY not in asked:  # a similarity is not a return
        quantities.add(VALUE)
    if LOG_PROB in asked:
        quantities.add(ENTROPY)
    if is_goal_space(algorithm.observation_space):
        quantities.add(GOALS)
    return quantities


def _stable_baselines_methods(algorithm: object) -> dict[str, Callable[..., Answer]]:
    policy = getattr(algorithm, "policy", None)
    if policy is None or not callable(getattr(policy, "obs_to_tensor", None)):
        return {}
    if (memory := _memory_of(algorithm)) is not None:
        return memory.methods()
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
        asked: dict[str, Callable[..., Answer]] = {Q_VALUES: networks.critic_q_values}
        if hasattr(policy.actor, "get_action_dist_params"):
            asked[LOG_PROB] = networks.actor_log_prob
        return asked
    return {}


def _memory_of(algorithm: object) -> _RecurrentNetworks | None:
    policy = getattr(algorithm, "policy", None)
    return _RecurrentNetworks(policy) if hasattr(policy, "lstm_actor") else None


class _RecurrentNetworks:
    """The networks of sb3-contrib's recurrent policies at one step of an episode, with its memory.

    Args:
        policy: The policy.
        states: Hidden and cell states of the actor's and of the critic's LSTM after the steps
            before; None: zeros, as at the first step.
            Shapes: ``(n_layers, 1, lstm_hidden_size)`` each.
    """

    def __init__(self, policy: Any, states: Any = None) -> None:
        self.policy = policy
        if states is None:
            from sb3_contrib.common.recurrent.type_aliases import RNNStates  # slow to import

            zeros = torch.zeros(policy.lstm_hidden_state_shape, device=policy.device)
            states = RNNStates((zeros, zeros), (zeros, zeros))
        self._states = states
        self._starts = torch.zeros(1, device=policy.device)

    def methods(self) -> dict[str, Callable[..., Answer]]:
        """Return how to ask for each quantity."""
        return {
            VALUE: self.state_values,
            LOG_PROB: self.evaluated_log_prob,
            ENTROPY: self.exact_entropy,
        }

    def after(self, batch: Observation) -> _RecurrentNetworks:
        """Return the networks at the next step."""
        with torch.no_grad():
            *_, states = self.policy(
                self._tensor(batch), self._states, self._starts, deterministic=True
            )
        return _RecurrentNetworks(self.policy, states)

    def state_values(self, batch: Observation) -> torch.Tensor:
        """Return the value network's answer."""
        return self.policy.predict_values(self._tensor(batch), self._states.vf, self._starts)

    def evaluated_log_prob(self, batch: Observation, actions: np.ndarray) -> torch.Tensor:
        """Return the log probability of actions in the environment's units."""
        return self._distribution(batch).log_prob(
            torch.as_tensor(actions, device=self.policy.device)
        )

    def exact_entropy(self, batch: Observation) -> torch.Tensor:
        """Return the policy's entropy."""
        return self._distribution(batch).entropy()

    def _distribution(self, batch: Observation) -> Any:
        return self.policy.get_distribution(self._tensor(batch), self._states.pi, self._starts)[0]

    def _tensor(self, batch: Observation) -> Tensors:
        return self.policy.obs_to_tensor(batch)[0]


class _PolicyNetworks:
    """The networks of one of Stable-Baselines3's policies, asked with batches."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def critic_q_values(self, batch: Observation, actions: np.ndarray) -> torch.Tensor:
        """Return one column per critic; TQC's critics say the mean of their quantiles."""
        answer = self.policy.critic(self._tensor(batch), self._scaled(actions))
        return torch.cat(answer, dim=1) if isinstance(answer, tuple) else answer.mean(dim=2)

    def discrete_q_values(self, batch: Observation, actions: np.ndarray) -> torch.Tensor:
        """Return the value of the chosen actions; QRDQN says the mean of its quantiles."""
        if hasattr(self.policy, "quantile_net"):
            q_values = self.policy.quantile_net(self._tensor(batch)).mean(dim=1)
        else:
            q_values = self.policy.q_net(self._tensor(batch))
        index = torch.as_tensor(np.asarray(actions).reshape(-1, 1), device=q_values.device)
        return q_values.gather(1, index.long())

    def actor_log_prob(self, batch: Observation, actions: np.ndarray) -> torch.Tensor:
        """Return the log density of actions scaled to [-1, 1]."""
        actor = self.policy.actor
        mean, log_std, more = actor.get_action_dist_params(self._tensor(batch))
        return actor.action_dist.proba_distribution(mean, log_std, **more).log_prob(
            self._scaled(actions)
        )

    def state_values(self, batch: Observation) -> torch.Tensor:
        """Return the value network's answer."""
        return self.policy.predict_values(self._tensor(batch))

    def evaluated_log_prob(self, batch: Observation, actions: np.ndarray) -> torch.Tensor:
        """Return the log probability of actions in the environment's units."""
        distribution = self.policy.get_distribution(self._tensor(batch))
        return distribution.log_prob(torch.as_tensor(actions, device=self.policy.device))

    def exact_entropy(self, batch: Observation) -> torch.Tensor:
        """Return the policy's entropy."""
        return self.policy.get_distribution(self._tensor(batch)).entropy()

    def _tensor(self, batch: Observation) -> Tensors:
        return self.policy.obs_to_tensor(batch)[0]

    def _scaled(self, actions: np.ndarray) -> torch.Tensor:
        scaled = self.policy.scale_action(np.asarray(actions)).reshape(len(actions), -1)
        return torch.as_tensor(scaled, dtype=torch.float32, device=self.policy.device)


def _example(space: spaces.Space) -> Any:
    """Return a member of a space; its random numbers stay where they are."""
    space = copy.deepcopy(space)
    space.seed(0)
    return space.sample()


def _numbers(answer: Answer) -> np.ndarray:
    return np.asarray(answer.detach().cpu() if isinstance(answer, torch.Tensor) else answer)


def _repeat(batch: Observation, n: int) -> Observation:
    if isinstance(batch, dict):
        return {key: np.repeat(value, n, axis=0) for key, value in batch.items()}
    return np.repeat(batch, n, axis=0)
