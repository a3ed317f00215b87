"""Every algorithm that has a YAML, shipped or in the project folder, passes the contract test."""

import pytest

from scilab_rl.config.workspace import config_files
from scilab_rl.errors import ConfigError
from scilab_rl.testing.algorithms import DEVICE_VARIABLE, AlgorithmContract, fitting_environment

ALGORITHMS = list(config_files("algorithm"))


class TestEveryAlgorithm(AlgorithmContract):
    @pytest.fixture(params=ALGORITHMS, autouse=True)
    def algorithm_name(self, request):
        self.algorithm = request.param


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_continues_without_goals_as_if_it_had_not_been_interrupted(algorithm, tmp_path):
    contract = AlgorithmContract()
    contract.algorithm = algorithm
    if getattr(contract._class(), "needs_goals", False):
        pytest.skip("it learns from goals alone")
    contract.env = fitting_environment(contract._class(), with_goals=False)
    if contract.env == fitting_environment(contract._class()):
        pytest.skip("the contract test above is without goals")
    contract.test_continues_as_if_it_had_not_been_interrupted(tmp_path)


@pytest.mark.parametrize(
    ("algorithm", "env"),
    [("sac", "BytesMove"), ("dqn", "OddPartsChoice"), ("cleandqn", "OddPartsChoice")],
)
def test_continues_with_odd_spaces_as_if_it_had_not_been_interrupted(algorithm, env, tmp_path):
    contract = AlgorithmContract()
    contract.algorithm = algorithm
    contract.env = f"tests.faults.archetypes:{env}-v0"
    contract.test_continues_as_if_it_had_not_been_interrupted(tmp_path)


def test_runs_on_the_device_that_the_environment_variable_names(monkeypatch):
    contract = AlgorithmContract()
    contract.algorithm = "cleansac"
    monkeypatch.setenv(DEVICE_VARIABLE, "cuda:99")
    with pytest.raises(ConfigError, match="device=cuda:99: PyTorch finds"):
        contract.build()


def test_there_is_something_to_check():
    assert len(ALGORITHMS) >= 10
