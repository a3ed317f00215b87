import sys
import types
from importlib import metadata

import gymnasium as gym
import pytest

from scilab_rl.envs import registration
from scilab_rl.envs.registration import known_env_ids, resolve_env_id, versions_by_family
from scilab_rl.errors import ConfigError, MissingDependencyError

TYPOS = [
    ("FetchReech-v4", "FetchReach-v4"),
    ("FetchReach4", "FetchReach-v4"),
    ("fetchreach-v4", "FetchReach-v4"),
    ("Fetch_Reach-v4", "FetchReach-v4"),
    ("FetchRaech", "FetchReach-v4"),
    ("FetchPsh-v4", "FetchPush-v4"),
    ("FetchPussh", "FetchPush-v4"),
    ("FethcPush-v1", "FetchPush-v4"),
    ("FetchSlde-v4", "FetchSlide-v4"),
    ("FetchPickandPlaces-v4", "FetchPickAndPlace-v4"),
    ("FetchPickNPlace", "FetchPickAndPlace-v4"),
    ("FetchReachDens-v4", "FetchReachDense-v4"),
    ("CartPol-v1", "CartPole-v1"),
    ("Cartpole", "CartPole-v1"),
    ("Pendulm-v1", "Pendulum-v1"),
    ("Pendelum-v1", "Pendulum-v1"),
    ("LunarLadner-v3", "LunarLander-v3"),
    ("MountianCar-v0", "MountainCar-v0"),
    ("Acrobat-v1", "Acrobot-v1"),
    ("HalfChetah-v5", "HalfCheetah-v5"),
    ("Hoper-v5", "Hopper-v5"),
    ("PointMaze_UMase-v3", "PointMaze_UMaze-v3"),
    ("HandReech-v3", "HandReach-v3"),
    ("BipedalWaker-v3", "BipedalWalker-v3"),
]


def test_typos_get_the_right_suggestion():
    right = 0
    for typo, meant in TYPOS:
        with pytest.raises(ConfigError) as error:
            resolve_env_id(typo)
        right += f"Did you mean '{meant}'?" in str(error.value)
    assert len(TYPOS) >= 20
    assert right / len(TYPOS) >= 0.9


@pytest.mark.parametrize(
    ("given", "used"),
    [
        ("FetchReach", "FetchReach-v4"),
        ("FetchPush-v4", "FetchPush-v4"),
        ("Pendulum", "Pendulum-v1"),
        ("CartPole-v0", "CartPole-v0"),
        ("scilab_rl.testing:TinyReach", "scilab_rl.testing:TinyReach-v0"),
        ("scilab_rl.testing:TinyReach-v0", "scilab_rl.testing:TinyReach-v0"),
    ],
)
def test_ids_that_can_be_made_come_without_a_notice(given, used):
    assert resolve_env_id(given) == (used, None)


@pytest.mark.parametrize("version", [1, 2, 3, 99])
def test_versions_that_are_gone_become_the_newest_with_a_notice(version):
    used, notice = resolve_env_id(f"FetchPush-v{version}")
    assert used == "FetchPush-v4"
    assert notice == f"FetchPush-v{version} is not available any more; using FetchPush-v4."


@pytest.mark.parametrize("given", ["", "  ", None, 3, ["FetchPush"]])
def test_what_is_no_text_is_refused(given):
    with pytest.raises(ConfigError, match="must be the id of an environment"):
        resolve_env_id(given)


@pytest.mark.parametrize("given", [":", "-v1", "v1", "../x", "Fetch\nPush", "a:b:c", "x" * 300])
def test_strange_names_are_one_error(given):
    with pytest.raises(ConfigError):
        resolve_env_id(given)


def test_a_module_that_cannot_be_imported_is_named():
    with pytest.raises(ConfigError, match="module 'no_such_module', which cannot be imported"):
        resolve_env_id("no_such_module:Id-v0")


def test_a_suite_that_is_not_installed_comes_with_its_extra(monkeypatch):
    monkeypatch.setattr(registration.Suite, "installed", False)
    extras = {
        "FetchReach": "robotics",
        "MetaW-reach": "metaworld",
        "parking-limited": "highway",
        "PandaReach": "panda",
        "myoHandPoseFixed": "myosuite",
        "LunarLander": "box2d",
        "BipedalWalker-v3": "box2d",
        "CoppeliaReach-v0": "coppeliasim",
    }
    for env_id, extra in extras.items():
        with pytest.raises(MissingDependencyError, match=rf"scilab-rl\[{extra}\]"):
            resolve_env_id(env_id)


def test_an_unversioned_id_of_ones_own_stays(monkeypatch):
    gym.register("MyOwnTask", entry_point="scilab_rl.testing.environments:TinyBox")
    try:
        assert resolve_env_id("MyOwnTask") == ("MyOwnTask", None)
    finally:
        del gym.registry["MyOwnTask"]


def test_known_ids_are_of_all_suites_and_can_be_made():
    ids = known_env_ids()
    assert {"FetchReach-v4", "Pendulum-v1"} <= set(ids)
    assert not {"FetchReach-v1", "FetchReach-v2"} & set(ids)
    assert versions_by_family(["B-v2", "A-v1", "B-v10"]) == {"A": ["A-v1"], "B": ["B-v2", "B-v10"]}


def test_finding_an_id_imports_only_its_suite():
    import subprocess

    code = (
        "import sys; from scilab_rl.envs.registration import resolve_env_id; "
        "resolve_env_id('Pendulum'); sys.exit('gymnasium_robotics' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_plug_ins_register_their_environments(monkeypatch, caplog) -> None:
    """Also those with a namespace, and a broken one does not stop the others."""
    plug_in = types.ModuleType("plugged")
    plug_in.root = lambda: gym.register("Plugged-v0", "scilab_rl.envs.reach_1dof:Reach1DOF")
    plug_in.named = lambda: gym.register("Named-v0", "scilab_rl.envs.reach_1dof:Reach1DOF")
    monkeypatch.setitem(sys.modules, "plugged", plug_in)
    points = [
        metadata.EntryPoint(name, value, registration.PLUG_INS)
        for name, value in (("__root__", "not_there:f"), ("__root__", "plugged:root"),
                            ("plugged", "plugged:named"))
    ]  # fmt: skip
    monkeypatch.setattr(metadata, "entry_points", lambda group: points)
    registration.register_plug_ins.cache_clear()
    try:
        assert resolve_env_id("Plugged") == ("Plugged-v0", None)
        assert resolve_env_id("plugged/Named")[0] == "plugged/Named-v0"
        assert "not_there:f cannot register its environments" in caplog.text
    finally:
        registration.register_plug_ins.cache_clear()
        gym.registry.pop("Plugged-v0", None)
        gym.registry.pop("plugged/Named-v0", None)
