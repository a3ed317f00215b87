"""Functions of goals, tried with goals and infos of the task itself."""

import numpy as np
import pytest

from scilab_rl.relabeling import answers_batches, for_batches, info_needs, reads_infos

ACHIEVED = np.array([[0.0], [1.0], [4.0]])
DESIRED = np.array([[3.0], [2.0], [0.0]])
INFOS = [{"effort": 1.0, "other": 0}] * 3


def of_batches(achieved, desired, infos):
    return -(np.abs(achieved - desired) > 0.5).any(axis=-1).astype(float)


def of_one_pair(achieved, desired, info):
    return -1.0 if np.linalg.norm(achieved - desired) > 0.5 else 0.0


def of_known_goals(achieved, desired, infos):
    """Fails for goals that the task does not have."""
    places = {0.0: 0, 1.0: 1, 2.0: 2, 3.0: 3, 4.0: 4}
    return np.array([-abs(places[a] - places[d]) for (a,), (d,) in zip(achieved, desired)])  # noqa: B905


def test_what_answers_batches_is_called_directly() -> None:
    for function in (of_batches, of_known_goals):
        assert for_batches(function, ACHIEVED, DESIRED, INFOS) is function


def test_one_value_for_all_pairs_is_no_constant_if_reached_goals_differ() -> None:
    """All pairs of the trial get -1 here, alone as together."""
    answer = for_batches(of_one_pair, ACHIEVED, DESIRED, INFOS)
    assert not answers_batches(answer)
    assert answer(ACHIEVED, ACHIEVED, INFOS).tolist() == [0.0, 0.0, 0.0]


def test_a_constant_is_spread() -> None:
    answer = for_batches(lambda *_: False, ACHIEVED, DESIRED, INFOS)
    assert answers_batches(answer)
    assert answer(ACHIEVED, DESIRED, INFOS).tolist() == [False] * 3


def test_a_function_that_cannot_take_batches_is_asked_one_by_one() -> None:
    def reward(achieved, desired, info):
        return 0.0 if achieved == desired else -info["effort"]

    answer = for_batches(reward, ACHIEVED, DESIRED, INFOS)
    assert answer(ACHIEVED, DESIRED, INFOS).tolist() == [-1.0] * 3


def test_what_infos_are_read_for_is_found() -> None:
    def required(achieved, desired, infos):
        return np.array([-info["effort"] for info in infos])

    def optional(achieved, desired, infos):
        return np.array([-info.get("effort", 0.0) - ("absent" in info) for info in infos])

    needs = info_needs(required, ACHIEVED, DESIRED, INFOS)
    assert (needs.keys, needs.is_required) == (("effort",), True)
    needs = info_needs(optional, ACHIEVED, DESIRED, INFOS)
    assert (needs.keys, needs.is_required) == (("effort",), False)
    for function in (required, optional):
        needs = info_needs(function, ACHIEVED, DESIRED, INFOS, kept=["effort"])
        assert (needs.keys, needs.is_required) == ((), False)
        assert reads_infos(function, ACHIEVED, DESIRED)
    assert not reads_infos(of_batches, ACHIEVED, DESIRED)


def test_the_missing_entry_is_named_and_not_what_the_other_form_failed_at() -> None:
    def reward(achieved, desired, infos):
        return np.array([-info["effort"] for info in infos])

    with pytest.raises(KeyError, match="effort"):
        for_batches(reward, ACHIEVED, DESIRED, [{}] * 3)
