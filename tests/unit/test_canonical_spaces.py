"""Whatever the space, what is sent is in it, and the way there and back loses nothing."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from scilab_rl.canonical_spaces import (
    CanonicalVecEnv,
    Conversion,
    action_conversion,
    conversions,
    observation_conversion,
    with_canonical_spaces,
)
from scilab_rl.errors import ConfigError
from scilab_rl.space_checks import bounds_problem

INTEGER = [np.dtype(f"{kind}{bits}") for kind in ("int", "uint") for bits in (8, 16, 32, 64)]
FLOATS = [np.dtype(f"float{bits}") for bits in (16, 32, 64)]
SHAPES = st.sampled_from([(), (1,), (3,), (2, 2)])
property_test = settings(derandomize=True, deadline=None, max_examples=150, database=None)


@st.composite
def boxes(draw: Any, dtypes: list[np.dtype]) -> spaces.Box:
    """Draw bounded boxes, also with dimensions in which only one value is allowed."""
    dtype, shape = draw(st.sampled_from(dtypes)), draw(SHAPES)
    if dtype.kind == "f":
        limit = 16000.0 if dtype == np.float16 else 2.0**100
        elements = st.floats(-limit, limit, width=min(dtype.itemsize * 8, 32))
    else:
        # Near the ends of the dtype differences overflow.
        limits = np.iinfo(dtype)
        near = st.integers(0, 300)
        elements = st.one_of(
            near.map(lambda n: limits.min + n if limits.min + n <= limits.max else limits.max),
            near.map(lambda n: limits.max - n if limits.max - n >= limits.min else limits.min),
        )
    one, other = (draw(hnp.arrays(dtype, shape, elements=elements)) for _ in range(2))
    space = spaces.Box(np.minimum(one, other), np.maximum(one, other), dtype=dtype.type)
    return space


@st.composite
def counted(draw: Any) -> spaces.Space:
    if draw(st.booleans()):
        return spaces.Discrete(draw(st.integers(1, 9)), start=draw(st.integers(-9, 9)))
    shape = draw(st.sampled_from([(1,), (3,), (2, 2)]))
    sizes = draw(hnp.arrays(np.int64, shape, elements=st.integers(1, 5)))
    start = draw(hnp.arrays(np.int64, shape, elements=st.integers(-9, 9)))
    return spaces.MultiDiscrete(sizes, start=start)


def drawn(space: Any, rng: np.random.Generator) -> np.ndarray:
    """Draw a value; Gymnasium's own sampling overflows at the ends of 64-bit integers."""
    if not isinstance(space, spaces.Box):
        space.seed(int(rng.integers(2**31)))
        return np.asarray(space.sample())
    pairs = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
    values = [low + int(rng.integers(high - low + 1)) for low, high in pairs]
    return np.array(values, space.dtype).reshape(space.shape)


def sent(conversion: Conversion, actions: np.ndarray) -> np.ndarray:
    """Return what the environment gets, after Stable-Baselines3's own scaling for SAC."""
    space: Any = conversion.space
    if isinstance(space, spaces.Box):
        low, high = space.low, space.high
        actions = low + (0.5 * (actions + np.float32(1.0)) * (high - low))
    return conversion.to_env(actions)


@property_test
@given(boxes(INTEGER + FLOATS), st.data())
def test_every_action_that_is_sent_is_in_the_space(space: spaces.Box, data: Any) -> None:
    if bounds_problem(space):
        return
    conversion = action_conversion(space)
    assert isinstance(conversion.space, spaces.Box)
    assert conversion.space.dtype == np.float32
    shape = (5, *(conversion.space.shape))
    inside = st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 1, width=32))
    actions = data.draw(hnp.arrays(np.float32, shape, elements=inside))
    for action in sent(conversion, actions):
        assert space.contains(np.asarray(action)), (action, space)
        assert np.asarray(action).dtype == space.dtype


@property_test
@given(st.one_of(boxes(INTEGER), counted()), st.integers(0, 2**31))
def test_there_and_back_is_the_identity(space: spaces.Space, seed: int) -> None:
    if isinstance(space, spaces.Box) and (
        bounds_problem(space) or np.any(space.high.astype(float) - space.low.astype(float) > 2**20)
    ):
        return  # float32 tells about a million values apart
    values = np.stack([drawn(space, np.random.default_rng([seed, i])) for i in range(8)])
    conversion = action_conversion(space)
    there = conversion.from_env(values)
    assert all(conversion.space.contains(np.asarray(value)) for value in there)
    np.testing.assert_array_equal(conversion.to_env(there), values)


@property_test
@given(boxes(FLOATS), st.integers(0, 2**31))
def test_real_numbers_come_back_as_exactly_as_float32_can_say(space: spaces.Box, seed: int) -> None:
    if bounds_problem(space):
        return
    space.seed(seed)
    values = np.array([space.sample() for _ in range(8)]).astype(space.dtype)
    conversion = action_conversion(space)
    back = conversion.to_env(conversion.from_env(values)).astype(np.float64)
    width = space.high.astype(np.float64) - space.low.astype(np.float64)
    spacing = np.spacing(np.abs(values)).astype(np.float64)
    assert np.all(np.abs(back - values) <= 2.0**-22 * width + spacing)


@pytest.mark.parametrize("dtype", INTEGER, ids=str)
@pytest.mark.parametrize("bounds", [(0, 5), ("min", "min + 5"), ("max - 5", "max"), (0, 255)])
def test_whole_numbers_are_reached_equally_often(dtype: np.dtype, bounds: Any) -> None:
    ends = {"min": int(np.iinfo(dtype).min), "max": int(np.iinfo(dtype).max)}
    low, high = (eval(str(bound), ends) for bound in bounds)
    high = min(high, ends["max"])
    space = spaces.Box(np.full(1, low, dtype), np.full(1, high, dtype), dtype=dtype.type)
    n = high - low + 1
    actions = np.linspace(-1, 1, 100 * n, dtype=np.float32)[:, None]
    values, counts = np.unique(action_conversion(space).to_env(actions), return_counts=True)
    assert [int(value) for value in values] == list(range(low, high + 1))
    assert counts.min() >= 99
    assert counts.max() <= 101


def test_int8_is_whole_from_end_to_end() -> None:
    space = spaces.Box(-128, 127, (1,), np.int8)
    sent = action_conversion(space).to_env(np.float32([[-1.0], [0.0], [1.0]]))
    assert sent.ravel().tolist() == [-128, 0, 127]


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (4,), np.float32),
        spaces.Box(np.float32([-2, 0]), np.float32([2, 1])),
        spaces.Discrete(3),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
        spaces.Box(0, 255, (36, 36, 3), np.uint8),
    ],
    ids=str,
)
def test_ordinary_spaces_get_no_layer(space: spaces.Space) -> None:
    if space.dtype != np.uint8:
        assert action_conversion(space).space is space
    assert observation_conversion(space).space is space


def test_a_locked_dimension_is_free_for_the_algorithm_and_locked_for_the_environment() -> None:
    space = spaces.Box(np.float32([-2, 7]), np.float32([2, 7]))
    conversion = action_conversion(space)
    assert conversion.space == spaces.Box(np.float32([-2, -1]), np.float32([2, 1]))
    assert conversion.to_env(np.float32([[0.3, -0.4], [9, 9]])).tolist() == [
        [np.float32(0.3), 7],
        [2, 7],
    ]
    assert conversion.from_env(np.float32([[0.3, 7]])).tolist() == [[np.float32(0.3), 0]]


def test_rounding_leads_nowhere_beyond_the_bounds() -> None:
    space = spaces.Box(np.float32([-0.7]), np.float32([0.1]))
    assert np.float32(-0.7) + (np.float32(0.1) - np.float32(-0.7)) > np.float32(0.1)
    assert sent(action_conversion(space), np.float32([[1.0]]))[0, 0] == np.float32(0.1)


class Told(gym.Env):
    """Gives one observation after another; episodes have two steps."""

    def __init__(self, space: spaces.Space, told: list[Any]) -> None:
        self.observation_space = space
        self.action_space = spaces.Discrete(2, start=5)
        self.told = told
        self.actions: list[int] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.count = 0
        return self.told[0], {}

    def step(self, action: Any) -> Any:
        self.actions.append(int(action))
        self.count += 1
        return self.told[self.count], 0.0, False, self.count == 2, {}


@pytest.mark.parametrize(
    ("space", "told", "read"),
    [
        (spaces.Discrete(3, start=4), [4, 5, 6], [0, 1, 2]),
        (
            spaces.MultiDiscrete([[6], [6]], start=[[1], [-1]]),
            np.array([[[1], [4]], [[2], [-1]], [[6], [0]]]),
            [[0, 5], [1, 0], [5, 1]],
        ),
        (spaces.Box(-1, 1, ()), np.float32([-1, 0, 0.5]), [[-1], [0], [0.5]]),
    ],
    ids=str,
)
@pytest.mark.parametrize("is_entry", [False, True])
def test_observations_are_read_alone_and_as_entries(
    space: spaces.Space, told: Any, read: Any, is_entry: bool
) -> None:
    if is_entry:
        space = spaces.Dict({"x": spaces.Box(-9, 9, (1,)), "y": space})
        told = [{"x": np.float32([i]), "y": value} for i, value in enumerate(told)]
    below = Told(space, list(told))
    env = with_canonical_spaces(DummyVecEnv([lambda: below]))
    entry = (lambda value: value["y"]) if is_entry else (lambda value: value)
    seen = [entry(env.reset())[0]]
    seen.append(entry(env.step(np.array([0]))[0])[0])
    last, _, _, infos = env.step(np.array([1]))
    seen.append(entry(infos[0]["terminal_observation"]))
    assert [np.asarray(value).tolist() for value in seen] == read
    assert np.asarray(entry(last)[0]).tolist() == read[0]  # of the next episode
    assert entry(env.observation_space).contains(np.asarray(seen[0]))
    assert below.actions == [5, 6]
    _, observations = conversions(VecNormalize(env, norm_obs=False))
    assert np.all(
        entry(observations.one_to_env(infos[0]["terminal_observation"])) == entry(told[2])
    )


def test_goals_are_never_converted() -> None:
    box = spaces.Box(-1, 1, (2,))
    kinds = {"observation": box, "achieved_goal": spaces.Discrete(3, start=1)}
    space = spaces.Dict(kinds | {"desired_goal": kinds["achieved_goal"]})
    with pytest.raises(ConfigError, match="'achieved_goal' is Discrete"):
        observation_conversion(space)
    observation_conversion(spaces.Dict(kinds))  # no goals without both


def test_no_layer_without_need() -> None:
    env = DummyVecEnv([lambda: gym.make("CartPole-v1")])
    assert with_canonical_spaces(env) is env
    assert not isinstance(env, CanonicalVecEnv)
