"""Does updates of sbx's SAC with hindsight replay on FetchReach, as `benchmarks/updates.py` asks.

Runs in the peers' virtual environment: sbx_sac.py STEPS BATCH_SIZE LAYER ...
"""

import gymnasium
import gymnasium_robotics
import jax
import sbx
from recorded import Requests, given, read_steps
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.logger import configure


def main() -> None:
    """Fill the replay buffer, then wait for work."""
    requests = Requests()
    path, batch_size, net_arch = given()
    gymnasium.register_envs(gymnasium_robotics)
    model = sbx.SAC(
        "MultiInputPolicy",
        gymnasium.make("FetchReach-v4"),
        batch_size=batch_size,
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs={"net_arch": net_arch},
        seed=1,
    )
    model.set_logger(configure(format_strings=[]))
    for step in read_steps(path):
        infos = [{"TimeLimit.truncated": step.over}]
        model.replay_buffer.add(
            step.now, step.following, step.action[None], [step.reward], [step.over], infos
        )

    def update(n_updates: int) -> None:
        model.train(n_updates, batch_size)
        jax.block_until_ready(model.policy.qf_state.params)

    requests.serve(update)


if __name__ == "__main__":
    main()
