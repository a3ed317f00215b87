"""Does everything still run? Each algorithm, environment, performance test and search, for seconds.

Nothing is listed here: what has a YAML file, or is registered, is run. Many short runs share a
process, so that imports are paid once: ``make smoke``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from scilab_rl.acceptance.runner import read_test
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.workspace import config_files
from scilab_rl.recording.records import FOLDER
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory
from scilab_rl.run.player import measure_run
from scilab_rl.run.run import resume_run
from scilab_rl.search.parsing import parse_space
from scilab_rl.search.space import SearchSpace
from tests.smoke.short_runs import (
    EPISODE,
    algorithms,
    can_draw,
    compose,
    environment_of,
    environments,
    finished_well,
    fitting_algorithm,
    missing_packages_skip,
    names_of_tests_and_searches,
    train,
)

pytestmark = [
    pytest.mark.smoke,
    # What the packages of simulators and of JAX say about themselves is not what is tested here.
    pytest.mark.filterwarnings("default"),
]
TESTS, SEARCHES = names_of_tests_and_searches()
_SHORTER = (
    "eval_after_n_steps=80",  # an update comes after one episode of each environment
    "n_epochs=1",
    "n_test_rollouts=1",
    "vector=inprocess",
    "mlflow=0",
    EPISODE,
)


@contextlib.contextmanager
def simulator_for(env: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, ...]]:
    """Run the stand-in for CoppeliaSim where an environment needs it; yield where it is."""
    if not env.startswith("Coppelia"):
        yield ()
        return
    pytest.importorskip("coppeliasim_zmqremoteapi_client")
    from tests.stand_ins.coppeliasim_server import StandIn
    from tests.unit.envs.test_coppeliasim import free_port

    monkeypatch.delenv("COPPELIASIM_ROOT", raising=False)
    port = free_port()
    simulators = [StandIn(port + 2 * index) for index in range(2)]  # training and evaluation
    try:
        yield (f"++env_kwargs.port={port}",)
    finally:
        for simulator in simulators:
            simulator.stop()


@pytest.mark.parametrize("algorithm", algorithms())
def test_algorithm_trains_saves_loads_and_resumes(algorithm: str, tmp_path: Path) -> None:
    env = environment_of(algorithm)
    told = (f"algorithm={algorithm}", f"env={env}", "save_model_freq=20")
    first = train(tmp_path, *told)
    assert finished_well(first)

    # Loading: another run starts from the policy.
    second = train(tmp_path, *told, f"restore_policy={first.run_dir}/rl_model_finished")
    assert finished_well(second)
    assert (measure_run(RunDirectory(Path(second.run_dir)), 1)).keys() >= {"eval/mean_reward"}

    # Resuming: the first run goes on where its checkpoint was.
    run = RunDirectory(Path(first.run_dir))
    cfg = load_recorded(run / CONFIG_FILE, ["n_epochs=2"])
    resumed = resume_run(cfg, run)
    assert finished_well(resumed, n_steps=80)
    assert resumed.epochs == 2


@pytest.mark.parametrize("env", environments())
def test_environment_trains_and_is_recorded(
    env: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with simulator_for(env, monkeypatch) as where:
        name = fitting_algorithm(env, *where)
        told = [f"algorithm={name}", f"env={env}", "tuned=false", EPISODE, *where]
        if draws := can_draw(env):
            told += ["render=record", "render_freq=1", "render_frames_per_clip=5"]
        result = train(tmp_path, *told)
    assert finished_well(result)
    films = list((Path(result.run_dir) / FOLDER).glob("*.mp4"))
    assert bool(films) == draws and all(film.stat().st_size > 500 for film in films)


@pytest.mark.parametrize("name", TESTS)
def test_performance_test_composes_and_starts(name: str, tmp_path: Path) -> None:
    """With its own networks and values, but few steps and a short episode."""
    with missing_packages_skip():
        test = read_test(name, [f"+performance={name}"])
    assert test.conditions.make_rule().max_runs >= 2
    result = train(tmp_path, *test.overrides, *_SHORTER)
    assert finished_well(result)
    assert test.conditions.eval_columns in result.metrics


@pytest.mark.parametrize("choice", SEARCHES)
def test_search_composes_and_starts(choice: str, tmp_path: Path) -> None:
    """With the lower end of every parameter, which is valid and usually cheap."""
    group, _, name = choice.partition("=")
    stored = OmegaConf.to_container(OmegaConf.load(config_files(group)[name]))
    space = SearchSpace(parse_space(stored["hydra"]["sweeper"]["search_space"]))
    setting = {p.name: p.labels[0] if p.choices else p.low for p in space.parameters}
    env = []
    if "env" not in stored:
        env = [f"env={environment_of(compose(f'+{choice}').algorithm.name)}"]
    overrides = [f"+{choice}", *env, *space.overrides(setting)]
    result = train(tmp_path, *overrides, *_SHORTER)
    assert finished_well(result)


def test_a_new_desk_algorithm_would_be_included(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "conf" / "algorithm").mkdir(parents=True)
    (tmp_path / "conf" / "algorithm" / "my_idea.yaml").write_text("name: my_idea\n")
    before = algorithms()
    monkeypatch.chdir(tmp_path)
    assert set(algorithms()) - set(before) == {"my_idea"}


def test_there_is_something_to_run() -> None:
    assert len(algorithms()) >= 15
    assert len(environments()) >= 15
    assert len(TESTS) >= 40
    assert len(SEARCHES) >= 10
