import logging
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from scilab_rl.config.compose import compose
from scilab_rl.config.recorded import as_yaml, load_recorded
from scilab_rl.config.schema import (
    ALIASES,
    BOOLEAN,
    INTEGER,
    KEYS,
    LIST,
    MAPPING,
    NUMBER,
    STRING,
    RunConfig,
    flatten,
    is_enabled,
    learning_part,
)
from scilab_rl.config.workspace import SHIPPED_CONF
from scilab_rl.errors import ConfigError


@pytest.fixture(scope="module")
def complete():
    return composed("seed=1", "tuned=false")


def composed(*overrides):
    return compose(overrides)


def changed(cfg, **values):
    return cfg.values() | values


def bad_values():
    """What cannot be, for every key of main.yaml."""
    bad = {
        NUMBER: ["abc", [], {}, True, float("nan"), float("inf"), "1e400"],
        INTEGER: ["abc", 1.5, [], {}, True, float("nan"), float("inf"), "7"],
        STRING: [1, 1.5, [], {}, True],
        BOOLEAN: ["perhaps", 2, -1, 0.5, [], {}],
        MAPPING: [1, "a", [1]],
        LIST: [1, "a", {"a": 1}, True],
    }
    for key in KEYS:
        values = bad[key.kind] + ([] if key.optional else [None])
        if key.low > float("-inf"):
            values = [*values, key.low - 1]
        for value in values:
            yield pytest.param(key.name, value, id=f"{key.name}={value!r}")


@pytest.mark.parametrize(("name", "value"), list(bad_values()))
def test_a_value_that_cannot_be_is_refused_with_its_key(complete, name, value):
    with pytest.raises(ConfigError, match=name) as error:
        RunConfig.from_values(changed(complete, **{name: value}))
    assert error.value.exit_code == 2
    assert "\n" not in str(error.value)


def test_there_are_enough_bad_values():
    assert len(list(bad_values())) >= 60


@pytest.mark.parametrize(
    "key", [key for key in KEYS if key.low > float("-inf")], ids=lambda k: k.name
)
def test_the_smallest_value_is_allowed(complete, key):
    smallest = int(key.low)
    cfg = RunConfig.from_values(changed(complete, **{key.name: smallest}))
    assert getattr(cfg, key.name) == smallest


@pytest.mark.parametrize("key", [key for key in KEYS if key.optional], ids=lambda k: k.name)
def test_optional_keys_may_be_empty(complete, key):
    cfg = RunConfig.from_values(changed(complete, **{key.name: None}))
    assert getattr(cfg, key.name) is None


@pytest.mark.parametrize(
    ("typo", "meant"),
    [
        ("n_epoch", "n_epochs"),
        ("nepochs", "n_epochs"),
        ("eval_after_steps", "eval_after_n_steps"),
        ("sed", "seed"),
        ("algoritm", "algorithm"),
        ("enviroment_kwargs", "env_kwargs"),
        ("early_stop_treshold", "early_stop_threshold"),
        ("wandbb", "wandb"),
        ("flaten_obs", "flatten_obs"),
        ("n_test_rolouts", "n_test_rollouts"),
        ("base_log_dir", "base_logdir"),
        ("render_frequency", "render_freq"),
    ],
)
def test_an_unknown_key_gets_a_suggestion(complete, typo, meant):
    with pytest.raises(ConfigError, match=f"There is no key '{typo}'. Did you mean '{meant}'"):
        RunConfig.from_values(changed(complete, **{typo: 1}))


def test_every_key_of_main_yaml_is_checked_and_every_checked_key_is_there():
    shipped = OmegaConf.load(SHIPPED_CONF / "main.yaml")
    assert set(shipped) - {"defaults", "hydra"} == {key.name for key in KEYS}
    with pytest.raises(AttributeError):  # a frozen dataclass
        RunConfig().n_epochs = 3  # type: ignore[misc]


def test_the_defaults_and_headings_of_main_yaml_are_those_of_the_schema():
    text, heading, found = (SHIPPED_CONF / "main.yaml").read_text(encoding="utf-8"), "", []
    for line in text.partition("\n\n")[2].splitlines():
        name = line.partition(":")[0]
        if line.startswith("# "):
            heading = line[2:]
        elif name.isidentifier() and name != "hydra":
            found.append((name, heading))
    assert found == [(key.name, key.heading) for key in KEYS]
    shipped = OmegaConf.load(SHIPPED_CONF / "main.yaml")
    assert [shipped[key.name] for key in KEYS] == [key.default for key in KEYS]
    assert RunConfig.from_values({"algorithm": {"_target_": "a.B"}}).values() == {
        **RunConfig().values(),
        "algorithm": {"name": "B", "_target_": "a.B"},
    }


def test_a_recorded_configuration_is_the_one_that_ran(tmp_path):
    cfg = composed("+flatten_obs=1", "info='1e-3'", "tags=[a,'2']", "env_kwargs.scale=1e-5")
    path = tmp_path / "config.yaml"
    path.write_text(as_yaml(cfg.values()))
    assert load_recorded(path) == cfg


@pytest.mark.parametrize(
    ("name", "given", "kept"),
    [("n_epochs", 3.0, 3), ("wandb", 1, True), ("mlflow", "auto", "auto"), ("mlflow", 0, False),
     ("early_stop_threshold", 1, 1), ("tags", None, None)],
)  # fmt: skip
def test_values_have_the_type_of_their_field(complete, name, given, kept):
    value = getattr(RunConfig.from_values(changed(complete, **{name: given})), name)
    assert value == kept
    assert type(value) is type(kept)


def test_keys_keep_the_order_of_their_meaning():
    assert len({key.meaning for key in KEYS}) == len({key.name for key in KEYS}) == len(KEYS)


def test_every_key_is_decided_whether_it_affects_learning():
    free = {key.name for key in KEYS if not key.affects_learning}
    assert {"viewer_host", "warn_after_seconds", "record_when", "vector", "info"} <= free
    learning = {"env", "env_kwargs", "wrappers", "n_envs", "on_nan", "seed", "restore_policy",
                "eval_after_n_steps", "n_epochs", "n_test_rollouts", "early_stop_data_column",
                "early_stop_threshold", "early_stop_last_n", "hyperopt_criterion"}  # fmt: skip
    assert {key.name for key in KEYS} - free == learning  # a new key must be decided here


def test_repeats_are_alike_whatever_their_seeds_and_looks(complete):
    values = complete.flat()
    other = {key: f"{value} changed" for key, value in values.items()}
    changed_keys = {key for key in values if key not in learning_part(values)}
    assert {"seed", "viewer_host", "tracking.mlflow.tracking_uri"} <= changed_keys
    assert learning_part(values | {key: other[key] for key in changed_keys}) == (
        learning_part(values)
    )


@pytest.mark.parametrize("algorithm", [None, {}, {"name": "x"}, "sac"])
def test_an_algorithm_needs_a_class(complete, algorithm):
    with pytest.raises(ConfigError, match="_target_"):
        RunConfig.from_values(changed(complete, algorithm=algorithm))


def test_aliases_become_wrappers_in_their_order(complete):
    aliases = dict.fromkeys(ALIASES, 1)
    cfg = RunConfig.from_values(changed(complete, **aliases, wrappers=[{"_target_": "mine"}]))
    targets = [wrapper["_target_"].rpartition(".")[2] for wrapper in cfg.wrappers]
    assert targets == [
        "ClipAction",
        "TimeAwareObservation",
        "FlattenObservation",
        "mine",
        "VecNormalize",  # outermost: algorithms store what is directly below it
    ]
    assert not set(ALIASES) & set(cfg.values())


@pytest.mark.parametrize(("observations", "rewards"), [(1, 0), (0, 1)])
def test_normalising_one_thing_leaves_the_other(complete, observations, rewards):
    cfg = RunConfig.from_values(
        changed(complete, normalize_obs=observations, normalize_reward=rewards)
    )
    assert cfg.wrappers[0]["norm_obs"] is bool(observations)
    assert cfg.wrappers[0]["norm_reward"] is bool(rewards)


def test_reading_leaves_the_values_unchanged(complete):
    values = changed(complete, flatten_obs=1)
    before = repr(values)
    RunConfig.from_values(values)
    assert repr(values) == before


def test_switches(complete):
    assert is_enabled(1) and is_enabled(True)
    assert not is_enabled(0) and not is_enabled("auto")
    assert is_enabled("auto", package="numpy")
    assert not is_enabled("auto", package="no_such_package_anywhere")


def test_a_flat_configuration_keeps_empty_groups():
    values = {"a": {"b": {"c": 1}, "d": {}}, "e": [1, {"f": 2}]}
    assert dict(flatten(values)) == {"a.b.c": 1, "a.d": {}, "e": [1, {"f": 2}]}


@pytest.mark.parametrize("env", ["FetchPush", "FetchPush-v1", "FetchPush-v4"])
def test_tuned_values_apply_to_every_version(env, caplog):
    with caplog.at_level(logging.DEBUG, "scilab_rl"):
        cfg = composed("algorithm=sac", f"env={env}")
    tuned = OmegaConf.load(SHIPPED_CONF / "tuned_values/FetchPush/sac.yaml")
    assert cfg.algorithm.arguments["learning_rate"] == tuned.algorithm.learning_rate
    assert "tuned=false" in caplog.text
    assert "FetchPush" in caplog.text


def test_the_command_line_beats_tuned_values_and_they_can_be_switched_off():
    cfg = composed("algorithm=sac", "env=FetchPush", "algorithm.learning_rate=0.5")
    assert cfg.algorithm.arguments["learning_rate"] == 0.5
    plain = OmegaConf.load(SHIPPED_CONF / "algorithm/sac.yaml")
    cfg = composed("algorithm=sac", "env=FetchPush", "tuned=false")
    assert cfg.algorithm.arguments["learning_rate"] == plain.learning_rate


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algorithm=sacc", r"no algorithm 'sacc'. Did you mean 'sac'"),
        ("n_epoch=3", r"no key 'n_epoch'. Did you mean 'n_epochs'"),
        ("flatten_obs=1", r"\+flatten_obs=1 with a plus"),
        ("n_epochs=[1", r"'n_epochs=\[1' cannot be read"),
        ("=", "Could not override ''"),
    ],
)
def test_hydras_errors_are_one_line(override, message):
    with pytest.raises(ConfigError, match=message) as error:
        composed(override)
    assert "\n" not in str(error.value)


RECORDED = (
    "env: TinyReach-v0\nseed: 3\nalgorithm:\n  name: a\n  _target_: {target}\n  gamma: {gamma}\n"
)


def record(folder, target="stable_baselines3.SAC", gamma="0.9"):
    path = folder / "config.yaml"
    path.write_text(RECORDED.format(target=target, gamma=gamma))
    return path


def test_a_recorded_configuration_comes_back_with_changes_and_newer_keys(tmp_path):
    cfg = load_recorded(record(tmp_path), ["++algorithm.gamma=0.5", "n_epochs=3"])
    assert (cfg.seed, cfg.algorithm.arguments["gamma"], cfg.n_epochs) == (3, 0.5, 3)
    assert cfg.n_test_rollouts == OmegaConf.load(SHIPPED_CONF / "main.yaml").n_test_rollouts


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "subprocess.Popen",
        "builtins.eval",
        "pathlib.Path.touch",
        "torch.load",
        "stable_baselines3.common.save_util.pickle.loads",
        "scilab_rl.files.os.system",
        "stable_baselines3.NoSuchClass",
    ],
)
def test_a_recorded_configuration_brings_no_code(tmp_path, target):
    with pytest.raises(ConfigError, match=r"config\.yaml' names"):
        load_recorded(record(tmp_path, target=target))


@pytest.mark.parametrize("gamma", ["${oc.env:HOME}", "${oc.decode:'1'}", "'a ${seed} b'"])
def test_a_recorded_configuration_interpolates_nothing(tmp_path, gamma):
    with pytest.raises(ConfigError, match="interpolation"):
        load_recorded(record(tmp_path, gamma=gamma))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "- a\n- b\n",
        "a: b: c",
        "a: [1",
        "\tx: 1",
        "x: 'y",
        "!!python/object:os.system {}",
        "{}: }",
    ],
)
def test_a_broken_recorded_configuration_is_one_line(tmp_path, text):
    path: Path = tmp_path / "config.yaml"
    path.write_text(text)
    try:
        load_recorded(path)
    except ConfigError as error:
        assert "\n" not in str(error)
    else:
        assert text == ""  # an empty file is a run with all defaults


@pytest.mark.parametrize("tenth", range(1, 10))
def test_a_cut_recorded_configuration_never_shows_a_traceback(tmp_path, complete, tenth):
    text = as_yaml(complete.values())
    path = tmp_path / "config.yaml"
    path.write_text(text[: len(text) * tenth // 10])
    try:
        load_recorded(path)
    except ConfigError as error:
        assert "\n" not in str(error)
