from __future__ import annotations

import pytest

from scilab_rl.config.compose import compose, friendly_override
from scilab_rl.config.schema import RunConfig
from scilab_rl.errors import ConfigError
from scilab_rl.run.checks import check_metrics


def composed(*overrides: str) -> RunConfig:
    return compose(["tuned=false", *overrides])


KEYS = ("early_stop_data_column", "hyperopt_criterion")


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize(
    ("algorithm", "metric", "message"),
    [
        ("cleansac", "eval/sucess_rate", "Did you mean 'eval/success_rate'"),
        ("cleansac", "train/anything", "cleansac records no 'train/anything'"),
        ("cleansac", "train/critic_los", "Did you mean 'train/critic_loss'"),
        ("cleandqn", "train/critic_loss", "There are .*train/q_mean"),
        ("sac", "train/ent_coef_los", "Did you mean 'train/ent_coef_loss'"),
        ("ppo", "train/critic_loss", "ppo records no"),
        ("random", "train/critic_loss", "random records no"),
        ("random", "time/fsp", "Did you mean 'time/fps'"),
    ],
)
def test_a_metric_that_an_algorithm_never_records_is_refused(
    key: str, algorithm: str, metric: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=f"{key}: .*{message}"):
        check_metrics(composed(f"algorithm={algorithm}", f"{key}={metric}"))


@pytest.mark.parametrize(
    "words",
    [
        ("algorithm=cleansac", "hyperopt_criterion=train/target_critic_variance"),
        ("algorithm=cleansac", "hyperopt_criterion=train/rollout_obs_step_3"),
        ("algorithm=sac", "early_stop_data_column=train/ent_coef_loss"),
        ("algorithm=sac", "algorithm.intrinsic=rnd", "hyperopt_criterion=train/intrinsic_loss"),
        ("algorithm=dqn", "hyperopt_criterion=rollout/exploration_rate"),
        ("algorithm=ddpg", "hyperopt_criterion=train/actor_loss"),
        ("algorithm=random", "early_stop_data_column=train/rollout_rewards_step"),
        (
            "render=record",
            "render_metrics_train=[train/rollout_rewards_step,train/ent_coef,q_value]",
        ),
    ],
)
def test_what_may_be_recorded_is_allowed(words: tuple[str, ...]) -> None:
    check_metrics(composed(*map(friendly_override, words)))


def test_metrics_beside_the_scene_are_checked_before_a_study_begins() -> None:
    words = ("render=record", "render_metrics_train=[critic_variance,train/critc_variance]")
    with pytest.raises(ConfigError, match="Did you mean 'train/target_critic_variance'"):
        check_metrics(composed(*words))
