"""Every cognitive model passes the contract test of models: its likelihood is what it does."""

import pytest

from scilab_rl.config.workspace import config_files
from scilab_rl.testing.models import ModelContract

MODELS = [
    name
    for name, path in config_files("algorithm").items()
    if ".algorithms.models." in path.read_text(encoding="utf-8")
]


class TestEveryModel(ModelContract):
    @pytest.fixture(params=MODELS, autouse=True)
    def model_name(self, request):
        self.algorithm = request.param


class TestSeveralArms(ModelContract):
    env = "Bandit-drifting-a4-v0"

    @pytest.fixture(params=[name for name in MODELS if name != "hybrid"], autouse=True)
    def model_name(self, request):
        self.algorithm = request.param

    test_gradients_are_finite = test_parameters_are_in_their_bounds = test_batch_equals_loop = None


def test_there_is_something_to_check():
    assert len(MODELS) >= 8
