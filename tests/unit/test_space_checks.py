"""What is refused is named, and the ways out lead out."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FilterObservation, FlattenObservation

from scilab_rl.errors import ConfigError
from scilab_rl.space_checks import bounds_problem, check_observations


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (spaces.Box(-np.inf, np.inf, (2,)), r"no bound in dimension 0 \(low -inf, high inf"),
        (spaces.Box(np.float32([-1, 0]), np.float32([1, np.inf])), "no bound in dimension 1"),
        (spaces.Box(-np.inf, np.inf, (2,), np.int64), "no bound in dimension 0"),
        *(
            (spaces.Box(-share * np.finfo(d).max, share * np.finfo(d).max, (1,), d), "so far apart")
            for d in (np.float16, np.float32, np.float64)
            for share in (1, 0.5)
        ),
        (spaces.Box(-1e300, 1e300, (), np.float64), "so far apart that they mean no bound .low"),
        (spaces.Box(-(2**62), 2**62, (1,), np.int64), "so far apart"),
        (spaces.Box(-128, 127, (1,), np.int8), None),
        (spaces.Box(-(2**31), 2**31 - 1, (1,), np.int32), None),
        (spaces.Box(-1e30, 1e30, (1,)), None),
        (spaces.Box(3, 3, (1,)), None),
    ],
    ids=str,
)
def test_bounds_that_are_none_are_told_apart(space: spaces.Box, words: str | None) -> None:
    problem = bounds_problem(space)
    if words is None:
        assert problem is None
    else:
        assert problem is not None
        with pytest.raises(AssertionError, match=words):
            raise AssertionError(problem)


BOX = spaces.Box(-1, 1, (2,))
UNREADABLE = [
    spaces.Text(9),
    spaces.Sequence(spaces.Discrete(2)),
    spaces.Graph(BOX, None),
    spaces.OneOf([BOX, spaces.Discrete(2)]),
    spaces.Dict({"a": BOX}),
    spaces.Tuple([BOX, spaces.Discrete(2, start=1)]),
]


@pytest.mark.parametrize("odd", UNREADABLE, ids=lambda space: type(space).__name__)
@pytest.mark.parametrize("alone", [True, False])
def test_the_ways_out_that_are_named_lead_out(odd: spaces.Space, alone: bool) -> None:
    kind = type(odd).__name__
    space = odd if alone else spaces.Dict({"odd.one": odd, "x": BOX, "y": spaces.Discrete(2)})
    if alone and kind == "Dict":
        space = spaces.Dict({"deep": odd})
    with pytest.raises(ConfigError) as caught:
        check_observations("Odd-v0", space)
    text = str(caught.value)
    assert text.startswith("Odd-v0: ")
    assert kind in text
    assert ("'odd.one'" in text) == (not alone)
    assert ("+flatten_obs=1" in text) == (kind not in ("Text", "Sequence", "Graph"))
    assert ("filter_keys: [x, y]" in text) == (not alone)
    env = gym.Env()
    env.observation_space, env.action_space = space, spaces.Discrete(2)
    if "+flatten_obs=1" in text:
        flat = FlattenObservation(env)
        check_observations("Odd-v0", flat.observation_space)
        flat.observation(space.sample())
    if not alone:
        check_observations("Odd-v0", FilterObservation(env, ["x", "y"]).observation_space)
