import pytest

from scilab_rl.errors import (
    CheckpointError,
    ConfigError,
    MissingDependencyError,
    ScilabRLError,
    did_you_mean,
    listing,
    nearest_word,
)

WORDS = ["algorithm", "env", "n_epochs", "eval_after_n_steps", "FetchReach-v4", "FetchPush-v4"]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("algoritm", "algorithm"),
        ("ALGORITHM", "algorithm"),
        ("nepochs", "n_epochs"),
        ("n-epoch", "n_epochs"),
        ("fetch_reach-v4", "FetchReach-v4"),
        ("FetchPsuh-v4", "FetchPush-v4"),
        ("eval_after_steps", "eval_after_n_steps"),
        ("zzz", None),
        ("", None),
    ],
)
def test_the_nearest_word_is_suggested(given, expected):
    assert nearest_word(given, WORDS) == expected
    suggestion = did_you_mean(given, WORDS)
    assert suggestion == (f" Did you mean '{expected}'?" if expected else "")


def test_nothing_is_near_to_nothing():
    assert did_you_mean("x", []) == ""


def test_a_word_counts_once_as_itself():
    assert did_you_mean("env", iter(WORDS)) == " Did you mean 'env'?"


def test_listings_are_ordered_and_say_what_they_hide():
    assert listing(["b", "a", "c"]) == "a, b, c"
    assert listing(["b", "a", "c"], limit=1) == "a, ... (2 more)"
    assert listing([]) == ""


def test_wrong_input_and_failed_runs_have_different_codes():
    assert (ScilabRLError.exit_code, CheckpointError.exit_code) == (1, 1)
    assert (ConfigError.exit_code, MissingDependencyError.exit_code) == (2, 2)


def test_a_missing_package_comes_with_the_command_that_installs_it():
    error = MissingDependencyError("wandb", "wandb", "to track runs")
    assert str(error) == (
        "wandb is needed to track runs and is not installed. "
        'Install it with: pip install "scilab-rl[wandb]"'
    )
