"""The ends of episodes, decoded from what a vector environment returns."""

import numpy as np
import pytest

from scilab_rl.envs.vec_step import at_ends, decode_step


def decode(new, dones, infos):
    before, actions = np.zeros(len(dones)), np.ones(len(dones))
    return decode_step(before, actions, new, np.arange(3.0), np.array(dones), infos)


ENDS = [
    {},
    {"terminal_observation": [7.0], "TimeLimit.truncated": True},
    {"terminal_observation": [8.0], "TimeLimit.truncated": False},
]


def test_a_truncated_and_a_terminated_episode():
    new = np.array([[1.0], [0.0], [0.5]], np.float32)
    step = decode(new, [False, True, True], ENDS)
    assert step.terminated.tolist() == [False, False, True]
    assert step.truncated.tolist() == [False, True, False]
    assert step.dones.tolist() == [False, True, True]
    assert step.next_observations.tolist() == [[1.0], [7.0], [8.0]]
    assert step.reset_observations.tolist() == new.tolist() == [[1.0], [0.0], [0.5]]
    assert step.next_observations.dtype == np.float32


def test_entries_of_dictionaries():
    ends = [info | {"terminal_observation": {"x": 5.0, "n": 3}} for info in ENDS]
    new = {"x": np.zeros(3, np.float32), "n": np.zeros(3, np.int64)}
    step = decode(new, [False, True, False], ends)
    assert {k: v.tolist() for k, v in step.next_observations.items()} == {
        "x": [0, 5, 0],
        "n": [0, 3, 0],
    }
    assert not new["x"].any()


def test_nothing_is_copied_while_no_episode_ends():
    new = np.zeros((3, 1))
    step = decode(new, [False] * 3, [{"TimeLimit.truncated": True}] * 3)
    assert step.next_observations is step.reset_observations is new
    assert not step.truncated.any()


def test_a_wrapper_that_reports_no_truncation_terminates():
    step = decode(np.zeros((1, 1)), [True], [{"terminal_observation": [1.0]}])
    assert (step.terminated.tolist(), step.truncated.tolist()) == ([True], [False])


def test_a_step_cannot_be_reassigned():
    with pytest.raises(AttributeError):
        decode(np.zeros((3, 1)), [False] * 3, ENDS).rewards = None


def test_what_was_last_where_an_episode_ended_and_first_elsewhere():
    dones, first = np.array([False, True]), {"x": np.array([[1.0], [2.0]], np.float32)}
    merged = at_ends(dones, {"x": np.array([[8.0], [9.0]])}, first)
    assert merged["x"].tolist() == [[1.0], [9.0]]
    assert merged["x"].dtype == np.float32
    assert at_ends(dones, -first["x"], first["x"]).tolist() == [[1.0], [-2.0]]
    assert first["x"].tolist() == [[1.0], [2.0]]
