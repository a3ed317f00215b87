import pytest

from scilab_rl.cli.resume import refuse_fixed_keys, with_total_epochs
from scilab_rl.errors import ConfigError
from scilab_rl.results import RunResult


@pytest.mark.parametrize("override", ["algorithm.gamma=0.9", "++algorithm=ppo", "env=A", "seed=2"])
def test_what_the_checkpoint_holds_cannot_change(override):
    with pytest.raises(ConfigError, match="restore_policy"):
        refuse_fixed_keys([override])


def test_the_course_of_the_run_can_change():
    changes = ["n_epochs=9", "++render=record", "early_stop_threshold=0.5"]
    assert refuse_fixed_keys(changes) is None  # it raises for what cannot change


def test_more_epochs_are_added_to_those_of_the_run(make_run):
    finished = make_run("100000-a", RunResult("finished", 0.5, 3, 300, 1.0, ""), n_epochs=3)
    assert with_total_epochs(["n_epochs=+5", "render=none"], finished) == [
        "n_epochs=8",
        "render=none",
    ]
    assert with_total_epochs(["++n_epochs=+1"], finished) == ["++n_epochs=4"]
    assert with_total_epochs(["n_epochs=7"], finished) == ["n_epochs=7"]


def test_a_solved_run_trains_on_only_with_another_threshold(make_run):
    solved = make_run("100000-a", RunResult("solved", 0.9, 2, 200, 1.0, ""), n_epochs=9)
    with pytest.raises(ConfigError, match=r"n_epochs=\+5 early_stop_threshold=2"):
        with_total_epochs(["n_epochs=+5"], solved)
    words = ["n_epochs=+5", "early_stop_threshold=2"]
    assert with_total_epochs(words, solved) == ["n_epochs=7", "early_stop_threshold=2"]
