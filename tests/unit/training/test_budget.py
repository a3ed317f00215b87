"""When an algorithm first learns, found from its parameters, agrees with when it does."""

from typing import Any

import pytest
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback

from scilab_rl.algorithms.cleanppo import CLEANPPO
from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.algorithms.random import RANDOM
from scilab_rl.config.schema import AlgorithmConfig, RunConfig
from scilab_rl.envs.vectorize import make_train_env
from scilab_rl.errors import ConfigError
from scilab_rl.training.budget import check_budget, first_update

BOX, DISCRETE = "scilab_rl.testing:TinyBox-v0", "scilab_rl.testing:TinyDiscrete-v0"
SMALL = {"buffer_size": 200, "batch_size": 4}
CASES = [
    (PPO, BOX, {"n_steps": 8, "batch_size": 8}, 1, 8),
    (PPO, BOX, {"n_steps": 8, "batch_size": 8}, 2, 16),
    (A2C, BOX, {"n_steps": 5}, 1, 5),
    (SAC, BOX, SMALL | {"learning_starts": 10}, 1, 11),
    (SAC, BOX, SMALL | {"learning_starts": 10, "train_freq": 4}, 2, 16),
    (DQN, DISCRETE, SMALL | {"learning_starts": 8, "train_freq": 4}, 1, 12),
    (CLEANSAC, BOX, SMALL | {"learning_starts": 10, "train_freq": 3}, 2, 12),
    (CLEANPPO, BOX, {"n_steps": 8, "batch_size": 8}, 1, 8),
]


class StopAt(BaseCallback):
    """Ends the training with the step that ends a budget, as the trainer does."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        return self.num_timesteps < self.step


def make(cls: Any, env_id: str, parameters: dict[str, Any], n_envs: int) -> Any:
    env = make_train_env(RunConfig(env_id, n_envs=n_envs, seed=1))
    policy = {} if cls.__module__.startswith("scilab_rl") else {"policy": "MlpPolicy"}
    return cls(env=env, **policy, **parameters)


def one_epoch(n_steps: int, name: str) -> RunConfig:
    return RunConfig(eval_after_n_steps=n_steps, n_epochs=1, algorithm=AlgorithmConfig(name))


def n_updates(model: Any) -> int:
    return model.n_updates if hasattr(model, "n_updates") else model._n_updates


@pytest.mark.parametrize(("cls", "env_id", "parameters", "n_envs", "step"), CASES)
def test_the_first_update_is_known(cls, env_id, parameters, n_envs, step) -> None:
    model = make(cls, env_id, parameters, n_envs)
    first = first_update(model)
    assert first is not None
    assert (first.step, first.is_certain) == (step, True)
    model.learn(step, callback=StopAt(step))
    assert n_updates(model) == 0
    with pytest.raises(ConfigError, match=f"first update comes after step {step} "):
        check_budget(one_epoch(step, "it"), model)
    model = make(cls, env_id, parameters, n_envs)
    model.learn(step + n_envs, callback=StopAt(step + n_envs))
    assert n_updates(model) > 0
    check_budget(one_epoch(step + 1, "it"), model)


def test_episodes_may_be_shorter_than_their_limit(caplog: pytest.LogCaptureFixture) -> None:
    model = make(SAC, BOX, SMALL | {"learning_starts": 10, "train_freq": (1, "episode")}, 1)
    first = first_update(model)
    assert first is not None
    assert not first.is_certain
    check_budget(one_epoch(first.step, "sac"), model)
    assert "sac may never learn" in caplog.text


def test_what_does_not_say_is_let_through() -> None:
    model = make(RANDOM, BOX, {}, 1)
    assert first_update(model) is None
    check_budget(one_epoch(1, "random"), model)


def test_large_batches_are_told(caplog: pytest.LogCaptureFixture) -> None:
    model = make(CLEANPPO, BOX, {"n_steps": 8, "batch_size": 64}, 1)
    check_budget(one_epoch(100, "cleanppo"), model)
    assert "batch_size=64 is more than the 8 steps of a rollout of n_steps=8 x n_envs=1" in (
        caplog.text
    )
