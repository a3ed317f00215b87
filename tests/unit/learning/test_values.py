import pytest
import stable_baselines3
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule

from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.errors import ConfigError
from scilab_rl.learning.arguments import check_arguments
from scilab_rl.learning.values import documented_values

SAC, PPO = stable_baselines3.SAC, stable_baselines3.PPO


def read(cls=SAC, build=None, **arguments):
    check_arguments("any", cls, arguments)
    return documented_values(cls, arguments, build)


@pytest.mark.parametrize("unit", ["step", "episode"])
@pytest.mark.parametrize("form", [[4, "{}"], "(4, '{}')", '[4, "{}"]', "4 {}", "(4,{})"])
def test_frequencies_have_units(form, unit):
    value = form.replace("{}", unit) if isinstance(form, str) else [4, unit]
    assert read(train_freq=value) == {"train_freq": (4, unit)}


@pytest.mark.parametrize("value", [[0, "step"], [1, "epoch"], ["episode", 1], "episode", [1], []])
def test_frequencies_that_cannot_be(value):
    with pytest.raises(ConfigError, match=r"train_freq must be a number of steps, \[N, step\]"):
        read(train_freq=value)


def test_numbers_stay():
    arguments = {"train_freq": 4, "learning_rate": 0.1, "gamma": 0.9, "policy_kwargs": None}
    assert read(**arguments) == arguments


@pytest.mark.parametrize(
    ("cls", "name"), [(SAC, "learning_rate"), (PPO, "learning_rate"), (PPO, "clip_range")]
)
@pytest.mark.parametrize("text", ["lin_0.001", "lin_1e-3", "lin_1.0E-3"])
def test_straight_lines_down_to_zero(cls, name, text):
    schedule = read(cls, **{name: text})[name]
    assert isinstance(schedule, LinearSchedule)
    assert [schedule(left) for left in (1.0, 0.5, 0.0)] == pytest.approx([1e-3, 5e-4, 0.0])


@pytest.mark.parametrize("text", ["lin", "lin_0", "lin_-1", "fast", "1e-3x"])
def test_schedules_that_cannot_be(text):
    with pytest.raises(ConfigError, match="must be a number, or lin_NUMBER"):
        read(learning_rate=text)


def test_one_file_algorithms_take_numbers_only():
    for arguments in ({"learning_rate": "lin_1e-3"}, {"train_freq": [1, "episode"]}):
        with pytest.raises(ConfigError, match="must be a number"):
            read(CLEANSAC, **arguments)


@pytest.mark.parametrize("as_target", [False, True])
def test_classes_by_their_names(as_target):
    def named(name):
        return {"_target_": name} if as_target else name

    found = read(
        replay_buffer_class=named("stable_baselines3.common.buffers.ReplayBuffer"),
        policy_kwargs={
            "activation_fn": named("torch.nn.Tanh"),
            "optimizer_class": named("torch.optim.AdamW"),
            "net_arch": {"pi": [8], "qf": [16, 16]},
        },
    )
    assert found == {
        "replay_buffer_class": ReplayBuffer,
        "policy_kwargs": {
            "activation_fn": torch.nn.Tanh,
            "optimizer_class": torch.optim.AdamW,
            "net_arch": {"pi": [8], "qf": [16, 16]},
        },
    }


def test_objects_are_built_where_they_stand():
    built = {}
    noise = NormalActionNoise(0, 1)

    def build(value, path):
        built[path] = value
        return noise

    assert read(build=build, action_noise={"_target_": "a.B", "mean": 0}) == {"action_noise": noise}
    assert built == {"algorithm.action_noise": {"_target_": "a.B", "mean": 0}}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("torch.nn.Tahn", r"activation_fn: there is no 'Tahn' in torch.nn. Did you mean 'Tanh'\?"),
        ("torch.relu", "activation_fn must be a class, but torch.relu is not one"),
        ("no_such_package.Tanh", "'no_such_package.Tanh' cannot be imported"),
    ],
)
def test_classes_that_cannot_be(name, message):
    with pytest.raises(ConfigError, match=message):
        read(policy_kwargs={"activation_fn": name})
