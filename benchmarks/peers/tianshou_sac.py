"""Does the work of Tianshou's SAC with hindsight replay on FetchReach, see `recorded`.

Runs in the peers' virtual environment: tianshou_sac.py STEPS|live BATCH_SIZE LAYER ...
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np
import torch
from recorded import HORIZON, Requests, given, read_steps
from tianshou.algorithm import SAC
from tianshou.algorithm.algorithm_base import policy_within_training_step
from tianshou.algorithm.modelfree.sac import AutoAlpha, SACPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, Collector, HERReplayBuffer
from tianshou.utils.net.common import Net, get_dict_state_decorator
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

BUFFER_SIZE = 1_000_000
LEARNING_RATE = 3e-4
N_RANDOM = 100  # steps before the first update
# One of five episodes keeps its goal, as with four relabeled transitions per original one.
FUTURE_K = 5


def main() -> None:
    """Fill the replay buffer, then wait for work."""
    requests = Requests()
    path, batch_size, net_arch = given()
    torch.manual_seed(1)
    np.random.seed(1)
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FetchReach-v4")
    algorithm = make_sac(env, net_arch)
    buffer = HERReplayBuffer(
        BUFFER_SIZE,
        compute_reward_fn=lambda achieved, goal: env.unwrapped.compute_reward(achieved, goal, {}),
        horizon=HORIZON,
        future_k=FUTURE_K,
    )
    if path is None:
        learn_live(algorithm, buffer, env, batch_size, requests)
        return
    for step in read_steps(path):
        buffer.add(
            Batch(
                obs=step.now,
                obs_next=step.following,
                act=step.action,
                rew=step.reward,
                terminated=False,
                truncated=step.over,
                info={},
            )
        )

    def update(n_updates: int) -> None:
        with policy_within_training_step(algorithm.policy):
            for _ in range(n_updates):
                algorithm.update(buffer, batch_size)

    requests.serve(update)


def learn_live(
    algorithm: SAC, buffer: HERReplayBuffer, env: Any, batch_size: int, requests: Requests
) -> None:
    """Step and update in turns, as Tianshou's trainer does it."""
    collector = Collector(algorithm, env, buffer)
    collector.reset()
    with policy_within_training_step(algorithm.policy):
        collector.collect(n_step=N_RANDOM, random=True)

        def learn(n_steps: int) -> None:
            for _ in range(n_steps):
                collector.collect(n_step=1)
                algorithm.update(buffer, batch_size)

        requests.serve(learn)


def make_sac(env: Any, net_arch: Sequence[int]) -> SAC:
    """Build SAC for goals, as Tianshou's example for Fetch builds DDPG."""
    shapes = {key: space.shape for key, space in env.observation_space.items()}
    of_dict, n_observations = get_dict_state_decorator(shapes, list(shapes))
    actions, rate = env.action_space, AdamOptimizerFactory(lr=LEARNING_RATE)
    body = of_dict(Net)(state_shape=n_observations, hidden_sizes=net_arch)
    actor = of_dict(ContinuousActorProbabilistic)(
        preprocess_net=body,
        action_shape=actions.shape,
        unbounded=True,
        conditioned_sigma=True,
    )
    critics = [
        of_dict(ContinuousCritic)(
            preprocess_net=of_dict(Net)(
                state_shape=n_observations,
                action_shape=actions.shape,
                hidden_sizes=net_arch,
                concat=True,
            )
        )
        for _ in range(2)
    ]
    return SAC(
        policy=SACPolicy(actor=actor, action_space=actions),
        policy_optim=rate,
        critic=critics[0],
        critic_optim=rate,
        critic2=critics[1],
        critic2_optim=rate,
        alpha=AutoAlpha(-float(np.prod(actions.shape)), 0.0, rate),
    )


if __name__ == "__main__":
    main()
