"""Every algorithm that has a YAML, shipped or on the desk, takes the exam by itself."""

import pytest

from scilab_rl.testing.algorithms import AlgorithmContract, fitting_environment
from scilab_rl.workspace import config_files

ALGORITHMS = list(config_files("algorithm"))


class TestEveryAlgorithm(AlgorithmContract):
    @pytest.fixture(params=ALGORITHMS, autouse=True)
    def examinee(self, request):
        self.algorithm = request.param


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_continues_without_goals_as_if_it_had_not_been_interrupted(algorithm, tmp_path):
    exam = AlgorithmContract()
    exam.algorithm = algorithm
    exam.env = fitting_environment(exam._class(), with_goals=False)
    exam.test_continues_as_if_it_had_not_been_interrupted(tmp_path)


def test_there_is_something_to_examine():
    assert len(ALGORITHMS) >= 10
