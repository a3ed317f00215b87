"""Every environment of Scilab-RL passes the contract test and moves as before."""

from __future__ import annotations

import pytest

from scilab_rl.envs import fingerprint
from scilab_rl.envs.ids import FAMILIES
from scilab_rl.testing.goal_environments import EnvironmentContract

VARIANTS = (
    "Blocks-o0-gripper_random-v1",
    "Blocks-o1-gripper_none-v1",
    "Blocks-o2-gripper_above-v1",
    "Blocks-o4-gripper_random-v1",
    "Hook-o0-v1",
    "Hook-o2-v1",
    "ButtonUnlock-o0-v1",
    "ButtonUnlock-o2-v1",
    "PointGym-dense-0.5-open_dg-c0-rt0-s200-v0",
    "PointGym-sparse-0.5-medium_custom_dgr-c1-rt0-s500-v0",
    "PointObjGym-sparse-o4-0.5-small_open_dgr-c1-rt0-s300-v0",
)
# The ant is slow, and CoppeliaSim needs a simulator: they have classes of their own.
ELSEWHERE = ("AntGym-v0", "CoppeliaReach-v0", "CoppeliaDrive-v0")
CHOICES = [family.env_id for family in FAMILIES if ".choices." in family.entry_point]
SHIPPED = [family.env_id for family in FAMILIES if family.env_id not in (*ELSEWHERE, *CHOICES)]
FETCH = ["FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4", "FetchSlide-v4"]


SLOW = [pytest.param(env_id, marks=pytest.mark.slow) for env_id in VARIANTS]


@pytest.fixture(params=[*SHIPPED, *SLOW])
def shipped(request):
    request.instance.env = request.param


@pytest.mark.usefixtures("shipped")
class TestShipped(EnvironmentContract):
    n_steps = 300

    def test_fingerprint_is_recorded(self) -> None:
        assert fingerprint.known(self.env)


@pytest.fixture(params=CHOICES)
def choice_task(request):
    request.instance.env = request.param


@pytest.mark.usefixtures("choice_task")
class TestChoiceTasks(EnvironmentContract):
    n_steps = 450  # more than the longest block

    def test_fingerprint_is_recorded(self) -> None:
        assert fingerprint.known(self.env)


@pytest.mark.slow
class TestAnt(EnvironmentContract):
    env = "AntGym-sparse-10-1.5-small_open_dgr-c1-rt0-s500-v0"
    n_steps = 300

    def test_fingerprint_is_recorded(self) -> None:
        assert fingerprint.known(self.env)


@pytest.fixture(params=FETCH)
def fetch(request):
    request.instance.env = request.param


@pytest.mark.slow
@pytest.mark.usefixtures("fetch")
class TestFetch(EnvironmentContract):
    def test_fingerprint_is_recorded(self) -> None:
        assert fingerprint.known(self.env)
