"""What to run, found from the YAML files and the registry, and how to run it in a second or two."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.envs.registration import load_env_creator
from omegaconf import OmegaConf

from scilab_rl.acceptance.conditions import performance_tests
from scilab_rl.config import compose as composition
from scilab_rl.config.workspace import config_files, open_project
from scilab_rl.envs.ids import FAMILIES
from scilab_rl.envs.registration import module_of, resolve_env_id
from scilab_rl.envs.vectorize import make_single_env
from scilab_rl.errors import ConfigError, MissingDependencyError
from scilab_rl.learning.compatibility import check_pair
from scilab_rl.results import RunResult
from scilab_rl.run.checks import algorithm_class, complete
from scilab_rl.run.directory import RunDirectory
from scilab_rl.run.run import start_run
from scilab_rl.testing.algorithms import fitting_environment

SHORT = (
    "eval_after_n_steps=40",
    "n_epochs=1",
    "n_test_rollouts=1",
    "mlflow=0",
    "seed=1",
    "vector=inprocess",
    "++tracking.console.enabled=false",
)
EPISODE = "++env_kwargs.max_episode_steps=20"
# Upper limits of what an algorithm may have; so each run does updates, small ones.
_LIMITS = {
    "batch_size": 16,
    "buffer_size": 1000,
    "learning_starts": 25,
    "n_epochs": 2,
    "gradient_steps": 2,
    "n_steps": 32,
    "train_freq": 4,
}


def algorithms() -> list[str]:
    """Return every algorithm that has a YAML, of the framework and of the project folder."""
    return sorted(config_files("algorithm"))


def environments() -> list[str]:
    """Return every environment that is shipped, in the project folder, or named in a YAML file."""
    before = set(gym.registry)
    open_project()
    found = {family.env_id for family in FAMILIES}
    found |= {i for i in set(gym.registry) - before if module_of(gym.spec(i)).startswith("custom_")}
    for group in ("performance", "search", "tuned_values"):
        for path in config_files(group).values():
            found |= {str(OmegaConf.load(path).get("env", ""))}
    return sorted(found - {""})


@contextlib.contextmanager
def missing_packages_skip() -> Iterator[None]:
    """Turn an optional package that is not installed into a skip with its reason."""
    try:
        yield
    except MissingDependencyError as error:
        pytest.skip(str(error))


def compose(*overrides: str) -> Any:
    """Compose a configuration with small values for what its algorithm has."""
    with missing_packages_skip():
        cfg = composition.compose(overrides)
        algorithm = cfg.algorithm.arguments
        small = [
            f"++algorithm.{key}={min(limit, algorithm[key])}"
            for key, limit in _LIMITS.items()
            if isinstance(algorithm.get(key), int)
            and not isinstance(algorithm[key], bool)
            # Stable-Baselines3's off-policy n_steps is the length of returns, not of rollouts.
            and not (key == "n_steps" and algorithm[key] < limit)
        ]
        if "data" in algorithm:  # of an offline algorithm
            small.append("++algorithm.data=random:3")
        # Few steps reach the first update only where few environments share them.
        return composition.compose([*overrides, *small, f"n_envs={min(2, cfg.n_envs)}"])


def train(base: Path, *overrides: str) -> RunResult:
    """Train in this process: imports are paid once for all runs."""
    cfg = compose(*SHORT, f"base_logdir={base}", *overrides)
    with missing_packages_skip():
        return start_run(cfg, list(overrides))


def finished_well(result: RunResult, *, n_steps: int = 40) -> bool:
    """Return whether a run has ended as it should and has left its files."""
    run = RunDirectory(Path(result.run_dir))
    files = ("config.yaml", "metrics.csv", "provenance.json", "rl_model_finished/manifest.json")
    return (
        result.status in ("finished", "solved")
        and result.steps >= n_steps
        and "eval/mean_reward" in result.metrics
        and all((run / name).is_file() for name in files)
    )


def fitting_algorithm(env_id: str, *overrides: str) -> str:
    """Return the first one-file algorithm whose spaces fit an environment."""
    cfg = compose(f"env={env_id}", *overrides)
    with missing_packages_skip():
        cfg = complete(cfg)
        env = make_single_env(cfg)
    for name in ("cleansac", "cleandqn", "cleanppo"):
        cls = algorithm_class(compose(f"algorithm={name}"))
        with contextlib.suppress(ConfigError):
            check_pair(name, cls, cfg.env, env)
            env.close()
            return name
    raise AssertionError(f"no algorithm fits {env_id}")


def can_draw(env_id: str) -> bool:
    """Return whether an environment says that it has frames; those of tests may have none."""
    target = gym.spec(resolve_env_id(env_id)[0].rpartition(":")[2]).entry_point
    made = load_env_creator(target) if isinstance(target, str) else target
    return "rgb_array" in getattr(made, "metadata", {"render_modes": ["rgb_array"]})["render_modes"]


def environment_of(algorithm: str) -> str:
    """Return the first tiny environment whose spaces fit an algorithm."""
    with missing_packages_skip():
        cls = algorithm_class(compose(f"algorithm={algorithm}"))
    return fitting_environment(cls)


def names_of_tests_and_searches() -> tuple[list[str], list[str]]:
    """Return the performance tests, and the searches as ``group=name``."""
    tests = sorted(performance_tests())
    searches = [f"search={name}" for name in sorted(config_files("search"))]
    others = sorted(set(config_files("performance")) - set(tests))
    return tests, [*searches, *(f"performance={name}" for name in others)]
