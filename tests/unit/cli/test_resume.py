import pytest

from scilab_rl.cli.resume import refuse_fixed_keys
from scilab_rl.errors import ConfigError


@pytest.mark.parametrize("override", ["algorithm.gamma=0.9", "++algorithm=ppo", "env=A", "seed=2"])
def test_what_the_checkpoint_holds_cannot_change(override):
    with pytest.raises(ConfigError, match="restore_policy"):
        refuse_fixed_keys([override])


def test_the_course_of_the_run_can_change():
    changes = ["n_epochs=9", "++render=record", "early_stop_threshold=0.5"]
    assert refuse_fixed_keys(changes) is None  # it raises for what cannot change
