"""Takes steps of EnvPool's environments with random actions, as the benchmarks ask; see `recorded`.

EnvPool has Fetch in C++, with MuJoCo linked into it, and steps many of them on a pool of threads.

Runs in the peers' virtual environment: envpool_steps.py ENVIRONMENT N_ENVS N_THREADS
"""

import sys

import envpool
import numpy as np
from recorded import Requests


def main() -> None:
    """Make the environments, and step all of them as often as is asked for."""
    requests = Requests()
    env_id, n_envs, n_threads = sys.argv[1], *map(int, sys.argv[2:])
    env = envpool.make_gymnasium(env_id, num_envs=n_envs, num_threads=n_threads, seed=1)
    random = np.random.default_rng(1)
    env.reset()

    def step(n_steps: int) -> None:
        for _ in range(n_steps):
            env.step(random.uniform(-1, 1, (n_envs, *env.action_space.shape)))

    requests.serve(step)


if __name__ == "__main__":
    main()
