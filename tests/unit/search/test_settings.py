from __future__ import annotations

import json
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from scilab_rl.config.schema import KEYS
from scilab_rl.config.workspace import SHIPPED_CONF
from scilab_rl.errors import ConfigError
from scilab_rl.machine import n_cores
from scilab_rl.parallel.launchers import n_workers
from scilab_rl.search.folders import expand_from_study, winner_overrides
from scilab_rl.search.samplers import SAMPLERS, make_sampler
from scilab_rl.search.settings import StudySettings, read_settings
from scilab_rl.search.sweep import is_study, read_request, refuse_changes


def parsed(*overrides: str) -> list:
    return OverridesParser.create().parse_overrides(list(overrides))


def test_shipped_file_has_exactly_the_keys_and_only_defaults() -> None:
    shipped = OmegaConf.to_container(OmegaConf.load(SHIPPED_CONF / "hydra/sweeper/study.yaml"))
    assert {shipped.pop("_target_"), shipped.pop("params")} == {
        "hydra_plugins.scilab_rl.sweeper.StudySweeper", None,
    }  # fmt: skip
    assert read_settings(shipped) == StudySettings()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"max_trails": 3}, "Did you mean 'max_trials'"),
        ({"max_trials": 0}, "whole number from 1"),
        ({"max_trials": 2.5}, "whole number from 1"),
        ({"n_jobs": "abc"}, "whole number from 1"),
        ({"n_jobs": True}, "whole number from 1"),
        ({"min_trials_per_param": 4, "max_trials_per_param": 3}, "must not be above"),
        ({"direction": "maximze"}, "Did you mean 'maximize'"),
        ({"sampler": "tpee"}, "Did you mean 'tpe'"),
        ({"pruner": "medain"}, "Did you mean 'median'"),
        ({"score": "fnal"}, "Did you mean 'final'"),
        ({"score": ["final", "auc"], "direction": "maximize"}, "2 scores and 1 directions"),
        ({"score": "steps_to_threshold", "direction": "maximize"}, "less is better"),
        ({"study_name": "../evil"}, "becomes a folder"),
        ({"study_name": "a/b"}, "becomes a folder"),
        ({"study_name": "-x"}, "becomes a folder"),
        ({"study_name": "x" * 300}, "becomes a folder"),
        ({"study_name": "a\nb"}, "becomes a folder"),
        ({"max_duration_minutes": -1}, "above 0"),
        ({"trial_timeout": float("nan")}, "above 0"),
    ],
)
def test_wrong_values_are_named(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_settings(given)


def test_few_trials_lower_the_repeats() -> None:
    settings = read_settings({"max_trials": 2})
    assert (settings.min_trials_per_param, settings.n_final_runs) == (2, 2)
    assert read_settings({"min_trials_per_param": 20}).max_trials_per_param == 20


def test_what_is_a_study_and_what_a_grid() -> None:
    assert not is_study({}, parsed("algorithm=sac,td3", "seed=1,2"))
    assert is_study({}, parsed("algorithm.gamma=interval(0.9,0.99)"))
    assert is_study({"study_name": "x"}, parsed("algorithm=sac,td3"))
    assert is_study({"search_space": {"++a": {}}}, parsed("algorithm=sac"))


def test_command_line_wins_over_the_file() -> None:
    space = {"++algorithm.gamma": {"type": "float", "low": 0.5, "high": 0.9}}
    overrides = parsed("env=X", "++algorithm.gamma=interval(0.9,0.99)", "hydra.sweeper.seed=3")
    request = read_request({"search_space": space}, overrides)
    assert [(p.low, p.high) for p in request.parameters] == [(0.9, 0.99)]
    assert request.fixed == ("env=X",)


def test_seeds_are_the_study_s_own() -> None:
    with pytest.raises(ConfigError, match="leave seed out"):
        read_request({"study_name": "x"}, parsed("seed=1,2"))
    with pytest.raises(ConfigError, match="nothing to search"):
        read_request({"study_name": "x"}, parsed("env=X"))


def test_workers_are_never_more_than_cores(caplog: pytest.LogCaptureFixture) -> None:
    assert n_workers(None) == n_cores()
    assert n_workers(1) == 1
    assert n_workers(n_cores() + 14) == n_cores()


@pytest.mark.parametrize("name", [name for name in SAMPLERS if name != "grid"])
def test_samplers_draw_the_same_from_the_same_seed(name: str) -> None:
    import optuna

    for package in SAMPLERS[name]:
        pytest.importorskip(package)

    def draw(seed: int) -> list[float]:
        study = optuna.create_study()
        for i in range(4):
            study.sampler = make_sampler(name, 5, seed + i)
            trial = study.ask()
            study.tell(trial, trial.suggest_float("x", 0, 1) + trial.suggest_float("y", 0, 1))
        return [value for trial in study.trials for value in trial.params.values()]

    assert draw(1) == draw(1)


OLD = {
    "configuration": {"n_epochs": "60", "env": "X"}, "score": ["default"],
    "directions": ["maximize"], "min_runs": 3, "space": {"a": {"low": 0.0, "high": 1.0}},
}  # fmt: skip


def test_a_study_keeps_its_budget() -> None:
    refuse_changes(OLD, OLD, StudySettings())
    shorter = OLD | {"configuration": {"n_epochs": "2", "env": "X"}}
    with pytest.raises(ConfigError, match=r"n_epochs: 60 \(now 2\).*another study_name"):
        refuse_changes(OLD, shorter, StudySettings(allow_space_change=True))


FREE = [key.name for key in KEYS if not key.affects_learning]


@pytest.mark.parametrize("key", [*FREE, "tracking.console.enabled"])
def test_a_study_goes_on_with_other_keys_that_do_not_affect_learning(key: str) -> None:
    """Also one of an earlier version, which has stored them."""
    stored = OLD | {"configuration": OLD["configuration"] | {key: "1"}}
    for new in (OLD, OLD | {"configuration": OLD["configuration"] | {key: "2"}}):
        refuse_changes(stored, new, StudySettings())


@pytest.mark.parametrize(
    ("entry", "difference"),
    [
        ({"low": -1.0, "high": 1.0}, r"'low': 0.0.*now.*'low': -1.0"),
        ({"low": 0.0, "high": 2.0}, r"'high': 1.0.*now.*'high': 2.0"),
        ({"choices": [0.0, 1.0]}, r"'high': 1.0.*now.*'choices': \[0.0, 1.0\]"),
        (None, r"'high': 1.0.*now absent"),
    ],
)
def test_f20_changed_space_is_refused_with_the_difference(entry: Any, difference: str) -> None:
    changed = OLD | {"space": {"a": entry} if entry else {}}
    remedies = "another study_name.*allow_space_change=true"
    with pytest.raises(ConfigError, match=f"{difference}.*{remedies}"):
        refuse_changes(OLD, changed, StudySettings())
    refuse_changes(OLD, changed, StudySettings(allow_space_change=True))


def test_best_of_needs_a_study_with_a_winner(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "data" / "studies" / "mine"
    folder.mkdir(parents=True)
    assert expand_from_study(["env=X"]) == ["env=X"]
    with pytest.raises(ConfigError, match="no study 'mine'"):
        expand_from_study(["+from_study=mine"])
    (folder / "study.yaml").write_text("{}")
    with pytest.raises(ConfigError, match="no winner yet"):
        expand_from_study(["+from_study=mine"])
    (folder / "winner.json").write_text('{"overrides": ["env=X", "n_epochs=9", "++a.b=0.5"]}')
    expected = ["env=X", "++a.b=0.5", "n_epochs=3"]
    assert expand_from_study(["+from_study=mine", "n_epochs=3"]) == expected
    assert expand_from_study(["--best-of", "mine", "n_epochs=3"]) == expected


@pytest.mark.parametrize(
    "override",
    ["algorithm._target_=os.system", "--config-dir=elsewhere", "-cd=elsewhere", "[1",
     "hydra.searchpath=[file://elsewhere]", "++hydra.launcher.x=1", "algorithm=../../elsewhere",
     "info=${oc.env:HOME}", "+a={_target_: os.mkdir}", "env=no_such_module_anywhere:Id-v0",
     "++algorithm.replay_buffer_class=os.system",
     "++algorithm.policy_kwargs.activation_fn=os.mkdir",
     "++algorithm.policy_kwargs={optimizer_class: os.mkdir}"],
)  # fmt: skip
def test_a_winner_brings_values_and_no_code(override, tmp_path) -> None:
    (tmp_path / "winner.json").write_text(json.dumps({"overrides": [override]}))
    with pytest.raises(ConfigError, match=r"winner\.json' (holds|names)"):
        winner_overrides(tmp_path)
