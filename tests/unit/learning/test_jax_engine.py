from __future__ import annotations

from typing import Any

import numpy as np
import pytest

jax = pytest.importorskip("jax")

import jax.numpy as jnp  # noqa: E402

from scilab_rl.errors import ConfigError, NumericalError  # noqa: E402
from scilab_rl.learning import jax_engine  # noqa: E402
from scilab_rl.learning.jax_engine import (  # noqa: E402
    Normalizer,
    UpdateRunner,
    dense_layers,
    forward,
    return_bounds,
    split_into_updates,
)


def add_up(state: Any, batch: Any, key: Any, index: Any) -> tuple[Any, dict[str, Any]]:
    """An update whose result tells what it was given."""
    weight = state["net"][0]["weight"] + batch.rewards.sum()
    return {"net": [{"weight": weight}]}, {"loss": weight[0, 0], "index": index}


def rounds(update: Any = add_up) -> UpdateRunner:
    return UpdateRunner(update, {"net": [{"weight": np.zeros((1, 1), np.float32)}]}, ["net"], "cpu")


def batch_of(*rewards: list[float]) -> Any:
    values = np.array(rewards, np.float32)
    empty = np.zeros((values.size, 1), np.float32)
    return split_into_updates(
        len(rewards),
        observations=empty,
        actions=empty,
        rewards=values.ravel(),
        next_observations=empty,
        dones=values.ravel(),
        return_bounds=np.zeros(2 * len(rewards), np.float32),
    )


def weight_of(acting: UpdateRunner) -> float:
    return float(acting.networks["net"][0]["weight"][0, 0])


def test_the_updates_of_a_round_follow_each_other() -> None:
    acting = rounds()
    acting.start(batch_of([1.0, 1.0], [10.0, 0.0], [100.0, 0.0]))
    losses = acting.finish()
    assert losses["loss"].tolist() == [2.0, 12.0, 112.0]
    assert losses["index"].tolist() == [0, 1, 2]
    assert acting.n_started == 3
    acting.start(batch_of([1.0]))
    assert acting.finish()["index"].tolist() == [3]


def test_networks_act_as_before_until_the_round_is_finished() -> None:
    acting = rounds()
    acting.start(batch_of([5.0]))
    assert weight_of(acting) == 0.0
    acting.finish()
    assert weight_of(acting) == 5.0
    assert acting.finish() == {}  # no round under way


def test_random_numbers_belong_to_the_update_and_not_to_the_round() -> None:
    def draw(state: Any, batch: Any, key: Any, index: Any) -> tuple[Any, dict[str, Any]]:
        return state, {"noise": jax.random.normal(key)}

    together, apart = rounds(draw), rounds(draw)
    together.seed = apart.seed = 3
    together.start(batch_of([0.0], [0.0]))
    drawn = []
    for _ in range(2):
        apart.start(batch_of([0.0]))
        drawn += apart.finish()["noise"].tolist()
    assert together.finish()["noise"].tolist() == drawn
    assert drawn[0] != drawn[1]


def test_a_loss_that_is_no_number_is_refused_with_its_update() -> None:
    acting = rounds()
    acting.start(batch_of([1.0], [np.nan]))
    with pytest.raises(NumericalError, match=r"loss is nan at update 2 \(gamma=0.9\)"):
        acting.finish(gamma=0.9)


def test_a_weight_that_is_no_number_is_refused() -> None:
    def poison(state: Any, batch: Any, key: Any, index: Any) -> tuple[Any, dict[str, Any]]:
        return {"net": [{"weight": jnp.full((1, 1), jnp.inf)}]}, {"loss": jnp.zeros(())}

    acting = rounds(poison)
    acting.start(batch_of([1.0]))
    with pytest.raises(NumericalError, match="a weight of the net is inf at update 1"):
        acting.finish()


def test_forward_by_hand_with_numpy_and_with_jax() -> None:
    # relu([1, -2] @ [[1, 0], [1, 1]] + [0, 3]) = relu([-1, 1]) = [0, 1]; [0, 1] @ [5, 7] + 0.5
    layers = [
        {"weight": np.array([[1.0, 0.0], [1.0, 1.0]]), "bias": np.array([0.0, 3.0])},
        {"weight": np.array([[5.0], [7.0]]), "bias": np.array([0.5])},
    ]
    inputs = np.array([[1.0, -2.0]])
    assert forward(layers, inputs, xp=np).tolist() == [[7.5]]
    assert forward(layers, inputs).tolist() == [[7.5]]
    assert forward(layers, jnp.array(inputs), precision="bfloat16").tolist() == [[7.5]]


def test_layer_norm_makes_hidden_layers_unit() -> None:
    # [3, 1]: mean 2, deviation 1 -> [1, -1], gain 2, offset 0.5 -> [2.5, -1.5] -> relu -> sum
    layers = [
        {
            "weight": np.eye(2),
            "bias": np.zeros(2),
            "gain": np.full(2, 2.0),
            "offset": np.full(2, 0.5),
        },
        {"weight": np.ones((2, 1)), "bias": np.zeros(1)},
    ]
    assert forward(layers, np.array([[3.0, 1.0]]), xp=np)[0, 0] == pytest.approx(2.5, abs=1e-5)


def test_an_ensemble_is_its_members_side_by_side() -> None:
    np.random.seed(0)
    layers = dense_layers([3, 4, 1], n=2, layer_norm=True)
    inputs = np.random.standard_normal((5, 3)).astype(np.float32)
    together = forward(layers, inputs, xp=np)
    assert together.shape == (2, 5, 1)
    for member in range(2):
        alone = [{name: values[member] for name, values in layer.items()} for layer in layers]
        np.testing.assert_allclose(forward(alone, inputs, xp=np), together[member], rtol=1e-6)


def test_normalizer_knows_mean_and_deviation_of_all_it_saw() -> None:
    values = np.random.default_rng(0).normal([1.0, -3.0], [2.0, 0.5], (90, 2))
    normalizer = Normalizer(2, active=True)
    for part in np.split(values, [1, 30, 77]):
        normalizer.update(part)
    expected = (values - values.mean(axis=0)) / values.std(axis=0)
    np.testing.assert_allclose(normalizer(values), expected, rtol=1e-5)
    assert normalizer(np.array([[1e9, -1e9]])).tolist() == [[5.0, -5.0]]


def test_normalizer_that_is_off_changes_nothing() -> None:
    normalizer = Normalizer(1, active=False)
    normalizer.update(np.array([[7.0]]))
    assert normalizer(np.array([[7.0]])).tolist() == [[7.0]]


@pytest.mark.parametrize(
    ("rewards", "expected"),
    [([-1.0, 0.0], [-10.0, 0.0]), ([2.0, 1.0], [1.0, 20.0]), ([-3.0, -1.0], [-30.0, -1.0])],
)
def test_returns_lie_between_one_reward_and_endlessly_many(
    rewards: list[float], expected: list[float]
) -> None:
    seen = np.array([np.inf, -np.inf])
    bounds = return_bounds(np.array(rewards), 0.9, seen)
    np.testing.assert_allclose(bounds, expected, rtol=1e-6)
    assert seen.tolist() == [min(rewards), max(rewards)]


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(ConfigError, match="no device 'abacus'"):
        jax_engine.prepare_jax("abacus")
