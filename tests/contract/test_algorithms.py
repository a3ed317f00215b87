"""Every algorithm that has a YAML, shipped or on the desk, takes the exam by itself."""

import pytest

from scilab_rl.testing.algorithms import AlgorithmContract
from scilab_rl.workspace import config_files


@pytest.fixture(params=list(config_files("algorithm")), autouse=True)
def examinee(request):
    request.instance.algorithm = request.param


class TestEveryAlgorithm(AlgorithmContract):
    pass
