from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import HerReplayBuffer

from scilab_rl.algorithms import cleansac
from scilab_rl.algorithms.cleansac import CLEANSAC, Actor
from scilab_rl.errors import NumericalError
from scilab_rl.learning.nn import gradient_step


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values).reshape(-1, 1)


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(env_id: str = "TinyReach-v0", n_envs: int = 1, **kwargs: Any) -> CLEANSAC:
        if env_id.startswith("TinyReach"):
            kwargs = {"replay_buffer_class": HerReplayBuffer} | kwargs
        small = {"buffer_size": 500, "learning_starts": 40, "batch_size": 16, "net_arch": [8]}
        return CLEANSAC(env=make_env(env_id, n_envs), seed=1, device="cpu", **(small | kwargs))

    return make_model


def weights(model: torch.nn.Module) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in model.parameters()]


def test_target_is_the_smallest_critic_plus_the_entropy() -> None:
    # y = r + gamma (1 - d) (min Q' - alpha log pi)
    #   = 1 + 0.5 (2 - 0.1 * -3) = 2.15;  where the episode is over: r alone
    targets = cleansac.soft_target(
        rewards=column(1.0, 1.0),
        dones=column(0.0, 1.0),
        next_q=torch.tensor([[4.0, 2.0], [4.0, 2.0]]),
        next_log_prob=column(-3.0, -3.0),
        ent_coef=0.1,
        gamma=0.5,
    )
    torch.testing.assert_close(targets, column(2.15, 1.0))


def test_temperature_falls_when_the_policy_is_more_random_than_wanted() -> None:
    # J = -log alpha * mean(log pi + H) = -ln 2 * ((-3 + 1 + -5 + 1) / 2) = 3 ln 2
    log_alpha = torch.tensor(math.log(2.0), requires_grad=True)
    loss = cleansac.temperature_loss(log_alpha, column(-3.0, -5.0), target_entropy=1.0)
    assert loss.item() == pytest.approx(3 * math.log(2.0))
    loss.backward()
    assert log_alpha.grad is not None
    assert log_alpha.grad.item() == pytest.approx(3.0)  # so descending lowers alpha


def test_critic_loss_is_half_the_squared_error_of_each_critic() -> None:
    # critic 1: (1 + 9) / 2 / 2 = 2.5; critic 2: (4 + 0) / 2 / 2 = 1
    loss = cleansac.critic_loss(torch.tensor([[1.0, 2.0], [3.0, 0.0]]), column(0.0, 0.0))
    assert loss.item() == pytest.approx(3.5)


def test_actor_loss_weighs_entropy_against_the_smallest_critic() -> None:
    # (0.5 * -2 - 1 + 0.5 * 4 - 3) / 2 = -1.5
    q_values = torch.tensor([[1.0, 7.0], [5.0, 3.0]])
    assert cleansac.actor_loss(column(-2.0, 4.0), q_values, 0.5).item() == pytest.approx(-1.5)


def test_squashed_density_by_hand() -> None:
    # a = tanh(u), u = mu + sigma eps = 0 + 1 * 1: log N(1) - log(1 - tanh(1)^2)
    noise = torch.tensor([[1.0]])
    result = cleansac.squashed_log_prob(noise, torch.zeros(1, 1), noise, scale=1.0)
    expected = -0.5 - 0.5 * math.log(2 * math.pi) - math.log(1 - math.tanh(1.0) ** 2)
    assert result.item() == pytest.approx(expected, abs=1e-6)
    # half the range, twice the density
    halved = cleansac.squashed_log_prob(noise, torch.zeros(1, 1), noise, scale=0.5)
    assert halved.item() == pytest.approx(expected + math.log(2.0), abs=1e-6)


def test_the_density_of_actions_integrates_to_one() -> None:
    torch.manual_seed(0)
    actor = Actor(n_observations=3, n_actions=1, net_arch=[4], scale=0.7)
    actions = torch.linspace(-0.6999, 0.6999, 20_001).reshape(-1, 1)
    observations = torch.ones(1, 3).expand(len(actions), 3)
    with torch.no_grad():
        density = actor.log_prob(observations, actions).exp().flatten()
    assert torch.trapezoid(density, actions.flatten()).item() == pytest.approx(1.0, abs=2e-3)


def test_density_of_a_drawn_action_is_the_density_of_that_action() -> None:
    torch.manual_seed(0)
    actor = Actor(n_observations=3, n_actions=2, net_arch=[4], scale=1.0)
    observations = torch.randn(50, 3)
    with torch.no_grad():
        actions, log_prob = actor.sample(observations)
        torch.testing.assert_close(
            actor.log_prob(observations, actions), log_prob, atol=1e-3, rtol=1e-3
        )


def test_bfloat16_is_for_matrix_products_alone(make: Any) -> None:
    exact, rough = make(precision="float32"), make(precision="bfloat16")
    observations = torch.linspace(-1, 1, 18).reshape(3, 6)
    actions = torch.linspace(1, -1, 6).reshape(3, 2)
    values = rough.critic(observations, actions)
    expected = exact.critic(observations, actions)
    assert values.dtype == torch.float32
    assert not torch.equal(values, expected)
    # 8 bits of mantissa: each of a layer's terms, of size 1 at most here, is off by 2^-9 or less.
    torch.testing.assert_close(values, expected, rtol=0, atol=8 * 2**-9)
    mean, log_std = rough.actor(observations)
    assert mean.dtype == log_std.dtype == torch.float32
    torch.testing.assert_close(mean, exact.actor(observations)[0], rtol=0, atol=8 * 2**-9)
    rough.learn(60)
    for network in (rough.actor, rough.critic, rough.critic_target):
        assert {parameter.dtype for parameter in network.parameters()} == {torch.float32}


def test_other_precisions_are_refused(make: Any) -> None:
    with pytest.raises(ValueError, match=r"precision must be float32 or bfloat16, .* 'half'"):
        make(precision="half")


@pytest.mark.parametrize(
    ("given", "expected"),
    [("auto", (True, 1.0)), ("auto_0.1", (True, 0.1)), (0.2, (False, 0.2)), ("0.3", (False, 0.3))],
)
def test_entropy_coefficient_is_learned_or_fixed(given: Any, expected: tuple[bool, float]) -> None:
    assert cleansac.parse_ent_coef(given) == expected


@pytest.mark.parametrize("given", ["much", "auto_0", "auto_x", -1.0, float("nan")])
def test_other_entropy_coefficients_are_refused(given: Any) -> None:
    with pytest.raises(ValueError, match="ent_coef must be auto"):
        cleansac.parse_ent_coef(given)


def test_target_entropy_is_minus_the_number_of_actions_or_as_given(make: Any) -> None:
    assert make().target_entropy == -2.0
    assert make(target_entropy=-0.5).target_entropy == -0.5


def test_nothing_is_learned_before_learning_starts(make: Any) -> None:
    model = make(learning_starts=40)
    before = weights(model.actor)
    model.learn(40)
    assert model.n_updates == 0
    assert all(map(torch.equal, before, weights(model.actor)))


def test_learning_changes_all_networks(make: Any) -> None:
    model = make(ent_coef="auto_0.5")
    actor, critic, target = map(weights, (model.actor, model.critic, model.critic_target))
    model.learn(60)
    assert model.n_updates == 20
    assert not any(map(torch.equal, actor, weights(model.actor)))
    assert not any(map(torch.equal, critic, weights(model.critic)))
    assert not any(map(torch.equal, target, weights(model.critic_target)))
    assert model.ent_coef.item() != 0.5


def test_a_fixed_entropy_coefficient_stays(make: Any) -> None:
    model = make(ent_coef=0.3)
    model.learn(50)
    assert model.ent_coef.item() == pytest.approx(0.3)


def test_descending_touches_the_optimizers_own_parameters_only(make: Any) -> None:
    model = make()
    critic = weights(model.critic)
    observations = torch.ones(4, model.n_observations)
    actions, log_prob = model.actor.sample(observations)
    loss = cleansac.actor_loss(log_prob, model.critic(observations, actions), 0.1)
    gradient_step(model.actor_optimizer, loss)
    assert all(parameter.grad is None for parameter in model.critic.parameters())
    assert all(map(torch.equal, critic, weights(model.critic)))
    assert all(parameter.grad is not None for parameter in model.actor.parameters())


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize(("gradient_steps", "updates"), [(1, 4), (3, 12), (-1, None)])
def test_gradient_steps_and_train_freq(
    make: Any, n_envs: int, gradient_steps: int, updates: int | None
) -> None:
    model = make(
        n_envs=n_envs, train_freq=5, gradient_steps=gradient_steps, learning_starts=40 * n_envs
    )
    model.learn(60 * n_envs)  # twelve rounds of five steps, the last four after learning_starts
    assert model.n_updates == (updates or 4 * 5 * n_envs)


def test_ignoring_dones_lets_values_continue(make: Any) -> None:
    model = make("TinyBox-v0", n_critics=1)
    model.learn(50)
    batch = model.sample(16)
    batch = batch._replace(dones=torch.ones_like(batch.dones))
    torch.testing.assert_close(model.compute_targets(batch), batch.rewards)
    model.ignore_dones_for_qvalue = True
    assert not torch.allclose(model.compute_targets(batch), batch.rewards)


@pytest.mark.parametrize("factor", [1.0, 0.3])
def test_actions_stay_within_the_scaled_bounds(make: Any, factor: float) -> None:
    model = make("TinyBox-v0", action_scale_factor=factor)
    model.learn(200)
    assert model.replay_buffer is not None
    stored = np.abs(model.replay_buffer.actions[:200])
    assert stored.max() <= factor + 1e-6
    assert stored[:40].max() > 0.8 * factor  # random at first, over the whole allowed range
    observations = np.random.default_rng(0).uniform(-1, 1, (20, 4)).astype(np.float32)
    for deterministic in (True, False):
        actions, _ = model.predict(observations, deterministic=deterministic)
        assert np.abs(actions).max() <= factor + 1e-6
        assert actions.dtype == np.float32


def test_deterministic_actions_are_always_the_same(make: Any) -> None:
    model = make("TinyBox-v0")
    observation = np.zeros(4, np.float32)
    first, second = (model.predict(observation, deterministic=True)[0] for _ in range(2))
    assert first.tolist() == second.tolist()
    assert model.predict(observation)[0].tolist() != model.predict(observation)[0].tolist()


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_seed_determines_the_weights(make: Any, n_envs: int) -> None:
    first, second = (make(n_envs=n_envs).learn(120) for _ in range(2))
    assert all(map(torch.equal, weights(first.actor), weights(second.actor)))
    assert all(map(torch.equal, weights(first.critic), weights(second.critic)))


def test_what_is_recorded(make: Any) -> None:
    model = make(log_obs_step=True, log_act_step=True)
    model.learn(50)
    values = model.logger.take()
    assert set(values) == {
        "train/actor_loss",
        "train/critic_loss",
        "train/target_critic_variance",
        "train/ent_coef",
        "train/ent_coef_loss",
        "train/rollout_q_step",
        "train/rollout_logpi_step",
        *(f"train/rollout_obs_step_{i}" for i in range(6)),
        *(f"train/rollout_act_step_{i}" for i in range(2)),
    }
    assert all(map(math.isfinite, values.values()))


def test_q_and_log_probability_belong_to_the_step_that_is_taken(make: Any) -> None:
    model = make(log_act_step=True)
    seen: list[tuple[float, float]] = []

    def look(_: Any, __: Any) -> bool:
        action = [model.logger.name_to_value[f"train/rollout_act_step_{i}"] for i in range(2)]
        expected = model.q_values(model._last_obs, np.array([action], np.float32)).min()
        seen.append((model.logger.take()["train/rollout_q_step"], expected.item()))
        return True

    model.learn(50, callback=look)
    assert len(seen) == 50
    for shown, expected in seen:
        assert shown == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("network", ["actor", "critic", "critic_target"])
def test_a_poisoned_weight_stops_learning(make: Any, network: str) -> None:
    model = make(learning_rate=0.01)
    model.learn(45)
    with torch.no_grad():
        next(getattr(model, network).parameters()).fill_(float("nan"))
    with pytest.raises(NumericalError, match=r"nan.* at update \d+ \(learning_rate=0.01, gamma"):
        model.train(1)


def test_a_learning_rate_that_explodes_stops_learning(make: Any) -> None:
    with pytest.raises(NumericalError, match="learning rate is too high"):
        make(learning_rate=1e30).learn(200)


def test_a_finite_loss_does_not_hide_a_weight_that_is_not(
    make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make()
    model.learn(41)

    def poison(optimizer: Any, loss: torch.Tensor) -> torch.Tensor:
        if optimizer is model.actor_optimizer:
            with torch.no_grad():
                next(model.actor.parameters()).fill_(float("inf"))
        return loss.detach()

    monkeypatch.setattr(cleansac, "gradient_step", poison)
    with pytest.raises(NumericalError, match=r"actor\.net\.0\.weight is inf at update 2"):
        model.train(1)
