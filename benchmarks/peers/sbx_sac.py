"""Does one update of sbx's SAC with hindsight replay on FetchReach for each line it reads.

Run by `benchmarks/updates.py` in the peers' virtual environment: sbx_sac.py BATCH_SIZE LAYER ...
"""

import sys
import time

import gymnasium
import gymnasium_robotics
import jax
import sbx
from stable_baselines3 import HerReplayBuffer

N_STEPS = 5_000


def main() -> None:
    """Fill the replay buffer with random steps, then wait for work."""
    batch_size, *net_arch = map(int, sys.argv[1:])
    gymnasium.register_envs(gymnasium_robotics)
    model = sbx.SAC(
        "MultiInputPolicy",
        gymnasium.make("FetchReach-v4"),
        batch_size=batch_size,
        learning_starts=10 * N_STEPS,
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs={"net_arch": net_arch},
        seed=1,
    )
    model.learn(N_STEPS)
    answer(0.0)
    for _ in sys.stdin:
        started = time.process_time()
        model.train(1, batch_size)
        jax.block_until_ready(model.policy.qf_state.params)
        answer(time.process_time() - started)


def answer(seconds: float) -> None:
    """Tell that the work is done, and how much processor time it took."""
    sys.stdout.write(f"{seconds}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
