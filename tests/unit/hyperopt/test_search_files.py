"""The shipped search spaces compose with their algorithms and take every value they offer."""

from __future__ import annotations

import hydra
import pytest
from omegaconf import OmegaConf

from scilab_rl import assembly, config
from scilab_rl.hyperopt.space import SearchSpace, parse_space
from scilab_rl.workspace import SHIPPED_CONF, config_files

SEARCHES = sorted(config_files("search"))


@pytest.fixture
def hydra_context():
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        yield


def read_space(name: str) -> SearchSpace:
    stored = OmegaConf.to_container(OmegaConf.load(SHIPPED_CONF / "search" / f"{name}.yaml"))
    return SearchSpace(parse_space(stored["hydra"]["sweeper"]["search_space"]))


def test_there_is_one_for_each_of_the_common_algorithms() -> None:
    wanted = {"sac", "td3", "ddpg", "tqc", "ppo", "dqn", "cleansac", "cleanppo", "cleandqn"}
    assert wanted <= set(SEARCHES)


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.parametrize("env", ["FetchReach", "Pendulum-v1"])
def test_both_ends_of_every_parameter_reach_the_algorithm(
    name: str, env: str, hydra_context: None
) -> None:
    space = read_space(name)
    for end in (0, -1):
        setting = {
            p.name: p.labels[end] if p.choices else (p.low, p.high)[end] for p in space.parameters
        }
        cfg = assembly.complete(
            config.compose([f"+search={name}", f"env={env}", *space.overrides(setting)])
        )
        for parameter in space.parameters:
            value = OmegaConf.select(cfg, parameter.name)
            wanted = parameter.choices[end] if parameter.choices else setting[parameter.name]
            assert value == wanted, parameter.name
