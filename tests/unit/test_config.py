import logging
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

from scilab_rl import config
from scilab_rl.config import KEYS, LIST, MAPPING, NUMBER, SWITCH, TEXT, WHOLE
from scilab_rl.errors import ConfigError
from scilab_rl.workspace import SHIPPED_CONF


@pytest.fixture(scope="module")
def complete():
    return composed("seed=1", "tuned=false")


def composed(*overrides):
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        return config.compose(overrides)


def changed(cfg, **values):
    cfg = cfg.copy()
    OmegaConf.set_struct(cfg, False)
    for name, value in values.items():
        cfg[name] = value
    return cfg


def bad_values():
    """What cannot be, for every key of main.yaml."""
    bad = {
        NUMBER: ["abc", [], {}, True, float("nan"), float("inf"), "1e400"],
        WHOLE: ["abc", 1.5, [], {}, True, float("nan"), float("inf"), "7"],
        TEXT: [1, 1.5, [], {}, True],
        SWITCH: ["perhaps", 2, -1, 0.5, [], {}],
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
        config.check_keys(changed(complete, **{name: value}))
    assert error.value.exit_code == 2
    assert "\n" not in str(error.value)


def test_there_are_enough_bad_values():
    assert len(list(bad_values())) >= 60


@pytest.mark.parametrize(
    "key", [key for key in KEYS if key.low > float("-inf")], ids=lambda k: k.name
)
def test_the_smallest_value_is_allowed(complete, key):
    config.check_keys(changed(complete, **{key.name: int(key.low)}))


@pytest.mark.parametrize("key", [key for key in KEYS if key.optional], ids=lambda k: k.name)
def test_optional_keys_may_be_empty(complete, key):
    config.check_keys(changed(complete, **{key.name: None}))


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
        config.check_keys(changed(complete, **{typo: 1}))


def test_every_key_of_main_yaml_is_checked_and_every_checked_key_is_there():
    shipped = OmegaConf.load(SHIPPED_CONF / "main.yaml")
    assert set(shipped) - {"defaults", "hydra"} == {key.name for key in KEYS}


def test_keys_keep_the_order_of_their_meaning():
    assert len({key.meaning for key in KEYS}) == len({key.name for key in KEYS}) == len(KEYS)


@pytest.mark.parametrize("name", ["early_stop_data_column", "hyperopt_criterion"])
def test_a_mistyped_metric_is_refused(complete, name):
    with pytest.raises(ConfigError, match=r"Did you mean 'eval/success_rate'"):
        config.check_keys(changed(complete, **{name: "eval/sucess_rate"}))
    config.check_keys(changed(complete, **{name: "train/my_own_metric"}))


@pytest.mark.parametrize("algorithm", [None, {}, {"name": "x"}, "sac"])
def test_an_algorithm_needs_a_class(complete, algorithm):
    with pytest.raises(ConfigError, match="_target_"):
        config.check_keys(changed(complete, algorithm=algorithm))


def test_aliases_become_wrappers_in_their_order(complete):
    aliases = dict.fromkeys(config.ALIASES, 1)
    cfg = config.prepare(changed(complete, **aliases, wrappers=[{"_target_": "mine"}]))
    targets = [wrapper["_target_"].rpartition(".")[2] for wrapper in cfg.wrappers]
    assert targets == [
        "ClipAction",
        "TimeAwareObservation",
        "FlattenObservation",
        "VecNormalize",
        "mine",
    ]
    assert not set(config.ALIASES) & set(cfg)


@pytest.mark.parametrize(("observations", "rewards"), [(1, 0), (0, 1)])
def test_normalising_one_thing_leaves_the_other(complete, observations, rewards):
    cfg = config.prepare(changed(complete, normalize_obs=observations, normalize_reward=rewards))
    assert cfg.wrappers[0].norm_obs is bool(observations)
    assert cfg.wrappers[0].norm_reward is bool(rewards)


def test_preparing_leaves_the_original_unchanged(complete):
    cfg = changed(complete, flatten_obs=1)
    before = OmegaConf.to_yaml(cfg)
    config.prepare(cfg)
    assert OmegaConf.to_yaml(cfg) == before


def test_switches(complete):
    assert config.switched_on(1) and config.switched_on(True)
    assert not config.switched_on(0) and not config.switched_on("auto")
    assert config.switched_on("auto", package="numpy")
    assert not config.switched_on("auto", package="no_such_package_anywhere")


def test_a_flat_configuration_keeps_empty_groups():
    cfg = OmegaConf.create({"a": {"b": {"c": 1}, "d": {}}, "e": [1, {"f": 2}]})
    assert config.flat(cfg) == {"a.b.c": 1, "a.d": {}, "e": [1, {"f": 2}]}


@pytest.mark.parametrize("env", ["FetchPush", "FetchPush-v1", "FetchPush-v4"])
def test_tuned_values_apply_to_every_version_with_a_notice(env, caplog):
    with caplog.at_level(logging.INFO, "scilab_rl"):
        cfg = composed("algorithm=sac", f"env={env}")
    tuned = OmegaConf.load(SHIPPED_CONF / "tuned_values/FetchPush/sac.yaml")
    assert cfg.algorithm.learning_rate == tuned.algorithm.learning_rate
    assert "tuned=false" in caplog.text
    assert "FetchPush" in caplog.text


def test_the_command_line_beats_tuned_values_and_they_can_be_switched_off():
    cfg = composed("algorithm=sac", "env=FetchPush", "algorithm.learning_rate=0.5")
    assert cfg.algorithm.learning_rate == 0.5
    plain = OmegaConf.load(SHIPPED_CONF / "algorithm/sac.yaml")
    cfg = composed("algorithm=sac", "env=FetchPush", "tuned=false")
    assert cfg.algorithm.learning_rate == plain.learning_rate


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
    cfg = config.load_recorded(record(tmp_path), ["++algorithm.gamma=0.5", "n_epochs=3"])
    assert (cfg.seed, cfg.algorithm.gamma, cfg.n_epochs) == (3, 0.5, 3)
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
        config.load_recorded(record(tmp_path, target=target))


@pytest.mark.parametrize("gamma", ["${oc.env:HOME}", "${oc.decode:'1'}", "'a ${seed} b'"])
def test_a_recorded_configuration_interpolates_nothing(tmp_path, gamma):
    with pytest.raises(ConfigError, match="interpolation"):
        config.load_recorded(record(tmp_path, gamma=gamma))


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
        config.load_recorded(path)
    except ConfigError as error:
        assert "\n" not in str(error)
    else:
        assert text == ""  # an empty file is a run with all defaults


@pytest.mark.parametrize("tenth", range(1, 10))
def test_a_cut_recorded_configuration_never_shows_a_traceback(tmp_path, complete, tenth):
    text = OmegaConf.to_yaml(complete)
    path = tmp_path / "config.yaml"
    path.write_text(text[: len(text) * tenth // 10])
    try:
        config.check_keys(config.load_recorded(path))
    except ConfigError as error:
        assert "\n" not in str(error)
