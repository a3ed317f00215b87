"""The shipped search spaces compose with their algorithms and take every value they offer."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from scilab_rl.config.compose import compose
from scilab_rl.config.workspace import SHIPPED_CONF, config_files
from scilab_rl.run.checks import complete
from scilab_rl.search.parsing import parse_space
from scilab_rl.search.space import SearchSpace

SEARCHES = sorted(config_files("search"))


def read_space(name: str) -> SearchSpace:
    stored = OmegaConf.to_container(OmegaConf.load(SHIPPED_CONF / "search" / f"{name}.yaml"))
    return SearchSpace(parse_space(stored["hydra"]["sweeper"]["search_space"]))


def test_there_is_one_for_each_of_the_common_algorithms() -> None:
    wanted = {"sac", "td3", "ddpg", "tqc", "ppo", "dqn", "cleansac", "cleanppo", "cleandqn"}
    assert wanted <= set(SEARCHES)


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.parametrize("env", ["FetchReach", "Pendulum-v1"])
def test_both_ends_of_every_parameter_reach_the_algorithm(name: str, env: str) -> None:
    space = read_space(name)
    for end in (0, -1):
        setting = {
            p.name: p.labels[end] if p.choices else (p.low, p.high)[end] for p in space.parameters
        }
        cfg = complete(compose([f"+search={name}", f"env={env}", *space.overrides(setting)]))
        for parameter in space.parameters:
            value = OmegaConf.select(OmegaConf.create(cfg.values()), parameter.name)
            wanted = parameter.choices[end] if parameter.choices else setting[parameter.name]
            assert value == wanted, parameter.name
