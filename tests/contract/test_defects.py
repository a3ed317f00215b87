"""The contract test itself is tested: each defect must fail the one test that is made for it."""

import dataclasses

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C
from stable_baselines3.common.callbacks import BaseCallback

from scilab_rl.testing.algorithms import AlgorithmContract

OTHER_GENERATOR = np.random.default_rng()


class Sound(A2C):
    pass


class UnseededNoise(A2C):
    def train(self):
        super().train()
        with torch.no_grad():
            next(self.policy.parameters()).add_(float(OTHER_GENERATOR.normal()))


class OrphanedOptimizer(A2C):
    """The defect of a well-known framework: after a load the optimizer holds other parameters."""

    def learn(self, *args, reset_num_timesteps=True, **kwargs):
        if not reset_num_timesteps:
            self.policy.optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
        return super().learn(*args, reset_num_timesteps=reset_num_timesteps, **kwargs)


class HiddenState(A2C):
    """Learns faster and faster, by a number that no checkpoint sees."""

    def _setup_model(self):
        super()._setup_model()
        rounds = [0]

        def scaled(_):
            rounds[0] += 1
            return rounds[0] * 1e-4

        self.lr_schedule = scaled


class EveryOtherStep(A2C):
    def learn(self, total_timesteps, callback=None, **kwargs):
        class Sometimes(BaseCallback):
            def _init_callback(self):
                callback.init_callback(self.model)

            def _on_training_start(self):
                callback.on_training_start({}, {})

            def _on_training_end(self):
                callback.on_training_end()

            def _on_step(self):
                return callback.on_step() if self.n_calls % 2 else True

        return super().learn(total_timesteps, callback=Sometimes(), **kwargs)


class Unstoppable(A2C):
    def collect_rollouts(self, *args, **kwargs):
        super().collect_rollouts(*args, **kwargs)
        return True


class RecordsNaN(A2C):
    def train(self):
        super().train()
        self.logger.record("train/loss", float("nan"))


class RecordsNothing(A2C):
    def train(self):
        super().train()
        self.logger.name_to_value.clear()


class RecordsUndeclared(A2C):
    def train(self):
        super().train()
        self.logger.record("train/bonus", 1.0)


class DeclaresUnrecorded(A2C):
    metrics = ("train/bonus",)


class Moody(A2C):
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return super().predict(observation, state, episode_start, deterministic=False)


class ChangesObservations(A2C):
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        observation["observation"] *= 0.5
        return super().predict(observation, state, episode_start, deterministic)


class OutOfBounds(A2C):
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        action, state = super().predict(observation, state, episode_start, deterministic)
        return action + 2.0, state


class OneEnvironmentOnly(A2C):
    def learn(self, *args, **kwargs):
        self.env.num_envs = 1
        return super().learn(*args, **kwargs)


class Collector(A2C):
    kept: list = []  # noqa: RUF012 - the leak

    def collect_rollouts(self, env, callback, rollout_buffer, n_rollout_steps):
        self.kept.append(np.ones(20_000))
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)


NEEDS_FOLDER = {
    "test_saved_policy_predicts_the_same",
    "test_continues_as_if_it_had_not_been_interrupted",
}


def take(test, cls, folder):
    contract = AlgorithmContract()
    contract.algorithm = cls
    arguments = [folder] if test in NEEDS_FOLDER else []
    getattr(contract, test)(*arguments)


DEFECTS = [
    ("test_same_seed_same_weights", UnseededNoise),
    ("test_continues_as_if_it_had_not_been_interrupted", OrphanedOptimizer),
    ("test_continues_as_if_it_had_not_been_interrupted", HiddenState),
    ("test_calls_the_callback_at_every_step", EveryOtherStep),
    ("test_stops_within_one_step_when_asked", Unstoppable),
    ("test_records_finite_metrics", RecordsNaN),
    ("test_records_finite_metrics", RecordsNothing),
    ("test_records_what_it_declares", RecordsUndeclared),
    ("test_records_what_it_declares", DeclaresUnrecorded),
    ("test_deterministic_prediction_repeats", Moody),
    ("test_predict_leaves_observations_unchanged", ChangesObservations),
    ("test_predict_has_the_usual_signature", OutOfBounds),
    ("test_learns_in_several_environments", OneEnvironmentOnly),
    pytest.param("test_memory_does_not_grow", Collector, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("test", "cls"), DEFECTS)
def test_a_defect_fails_the_contract(test, cls, tmp_path):
    take(test, Sound, tmp_path / "sound")
    with pytest.raises(AssertionError):
        take(test, cls, tmp_path / "defect")


def test_yaml_with_a_parameter_too_few_or_too_many_fails(monkeypatch):
    from scilab_rl.testing import algorithms

    complete = algorithms._composed("a2c")
    contract = AlgorithmContract()
    contract.algorithm = "a2c"
    contract.test_yaml_lists_the_constructors_parameters()
    arguments = complete.arguments
    for broken in (
        {**arguments, "learning_rat": 1},
        {k: arguments[k] for k in arguments if k != "gamma"},
    ):
        changed = dataclasses.replace(complete, arguments=broken)
        monkeypatch.setattr(algorithms, "_composed", lambda name, yaml=changed: yaml)
        with pytest.raises(AssertionError, match=r"learning_rat|gamma"):
            contract.test_yaml_lists_the_constructors_parameters()
