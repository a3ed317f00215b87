"""Does the work of Stable-Baselines3's SAC with hindsight replay on FetchReach.

Updates on recorded steps, or, without a file of them, steps of a run that learns; see `recorded`.

Runs in the peers' virtual environment: sb3_sac.py STEPS|live BATCH_SIZE LAYER ...
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import gymnasium_robotics
from recorded import Requests, given, read_steps
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.logger import configure


def serve(sac: type[Any], wait: Callable[[Any], object] = lambda _: None) -> None:
    """Build the algorithm, and work on request.

    Args:
        sac: Stable-Baselines3's class, or one like it.
        wait: Returns when the updates of a model have been computed.
    """
    requests = Requests()
    path, batch_size, net_arch = given()
    gymnasium.register_envs(gymnasium_robotics)
    model = sac(
        "MultiInputPolicy",
        gymnasium.make("FetchReach-v4"),
        batch_size=batch_size,
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs={"net_arch": net_arch},
        seed=1,
    )
    model.set_logger(configure(format_strings=[]))
    if path is None:
        requests.serve(lambda n_steps: model.learn(n_steps, reset_num_timesteps=False))
        return
    for step in read_steps(path):
        infos = [{"TimeLimit.truncated": step.over}]
        model.replay_buffer.add(
            step.now, step.following, step.action[None], [step.reward], [step.over], infos
        )

    def update(n_updates: int) -> None:
        model.train(n_updates, batch_size)
        wait(model)

    requests.serve(update)


if __name__ == "__main__":
    serve(SAC)
