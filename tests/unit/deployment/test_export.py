"""Every kind of policy acts the same after its export, by NumPy and by ONNX."""

from __future__ import annotations

import builtins
import json
import subprocess
import sys
from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from scilab_rl.cli.main import run_command_line
from scilab_rl.config.compose import compose
from scilab_rl.deployment.description import Entry, Layer, Output, PolicyDescription, describe
from scilab_rl.deployment.export import (
    ONNX_FILE,
    describe_numbers,
    draw_observations,
    run_onnx,
    write_files,
)
from scilab_rl.deployment.onnx_graph import write_onnx
from scilab_rl.deployment.run_policy import TOLERANCE, Policy
from scilab_rl.envs.vectorize import make_eval_env
from scilab_rl.errors import ConfigError, MissingDependencyError, ScilabRLError
from scilab_rl.run.checks import complete
from scilab_rl.run.parts import make_algorithm

N_OBSERVATIONS = 400
GOALS, BOX = "scilab_rl.testing:TinyReach-v0", "scilab_rl.testing:TinyBox-v0"
CHOICE, GOALS_CHOICE = (
    "scilab_rl.testing:TinyDiscrete-v0", "scilab_rl.testing:TinyReachDiscrete-v0",
)  # fmt: skip
CASES = [
    *((name, GOALS) for name in ("cleansac", "cleansacmc", "actor_critic", "jaxsac", "jaxtd3")),
    ("jaxcrl", GOALS),
    ("jaxgciql", GOALS),
    *((name, GOALS) for name in ("sac", "td3", "ddpg", "tqc", "ppo", "cleanppo")),
    *((name, BOX) for name in ("cleansac", "jaxsac", "sac", "td3", "ppo", "cleanppo", "a2c")),
    *((name, CHOICE) for name in ("cleandqn", "dqn", "qrdqn", "ppo", "cleanppo", "onestepac")),
    *((name, GOALS_CHOICE) for name in ("cleandqn", "dqn", "trpo")),
]


class Odd(gym.Env):
    """Spaces of kinds that algorithms are never given as they are."""

    def __init__(self, dtype="float64", choices=False, picture=False):
        self.observation_space = spaces.Dict(
            tool=spaces.Discrete(3, start=2),
            switches=spaces.MultiDiscrete([2, 3], start=[1, 0]),
            force=spaces.Box(-9, 9, (), np.float64),
            lights=spaces.MultiBinary(2),
        )
        if picture:
            self.observation_space = spaces.Box(0, 255, (36, 36, 3), np.uint8)
        high = [4, 1 if dtype == "float32" else 7]
        self.action_space = spaces.Box(
            np.array([-2, 1], dtype), np.array(high, dtype), dtype=np.dtype(dtype).type
        )
        if choices:
            self.action_space = spaces.Discrete(3, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), 0.0, False, False, {}


@pytest.fixture(scope="module", autouse=True)
def odd():
    gym.register("scilab_test/Odd-v0", Odd, max_episode_steps=20)
    yield
    gym.registry.pop("scilab_test/Odd-v0")


def build(algorithm, env, *overrides):
    cfg = complete(
        compose([f"algorithm={algorithm}", f"env={env}", "tuned=false", "seed=3", *overrides])
    )
    model = make_algorithm(cfg, make_eval_env(cfg))
    normalizer = getattr(model, "normalizer", None)
    if normalizer is not None:  # as after some steps
        normalizer.update(np.random.default_rng(1).normal(2.0, 0.2, (50, normalizer.n_normalized)))
    return model


def export(model, folder, n=N_OBSERVATIONS):
    with closing(model.get_env()):
        description = describe(model)
        observations = draw_observations(model, description, n, seed=3)
        assert all(len(values) == n for values in observations.values())
        return write_files(folder, model, description, observations, {})


@pytest.mark.parametrize(("algorithm", "env"), CASES)
def test_every_algorithm(algorithm, env, tmp_path) -> None:
    overrides = ["algorithm.normalize_observations=true"] if algorithm.startswith("jax") else []
    report = export(build(algorithm, env, *overrides), tmp_path)
    assert report["observations"] == N_OBSERVATIONS
    assert 0 <= report["numpy"] <= TOLERANCE and 0 <= report["onnx"] <= TOLERANCE


@pytest.mark.parametrize("algorithm", ["cleansac", "jaxsac", "sac", "ppo"])
@pytest.mark.parametrize("env", [GOALS, BOX])
def test_normalization_by_vecnormalize_is_part_of_it(algorithm, env, tmp_path) -> None:
    model = build(algorithm, env, "+normalize_obs=1")
    moments = model.get_env().obs_rms
    for entry in moments.values() if isinstance(moments, dict) else [moments]:
        entry.mean += 0.3
        entry.var *= 0.01
    report = export(model, tmp_path)
    assert report["numpy"] <= TOLERANCE and report["onnx"] <= TOLERANCE
    contract = json.loads((tmp_path / "contract.json").read_text())
    first = contract["observation"][0]["normalization"]
    assert first["mean"][0] == pytest.approx(0.3) and first["limit"] == 10.0
    assert first["scale"][0] == pytest.approx(0.1, rel=1e-3)


@pytest.mark.filterwarnings("ignore:.*A Box action space maximum and minimum values are equal")
@pytest.mark.parametrize("algorithm", ["cleansac", "sac", "ppo", "cleanppo"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_actions_of_other_kinds_and_discrete_entries(algorithm, dtype, tmp_path) -> None:
    model = build(algorithm, "scilab_test/Odd-v0", f"+env_kwargs.dtype={dtype}")
    assert export(model, tmp_path)["onnx"] <= TOLERANCE
    one = {"tool": 3, "switches": np.array([2, 0]), "force": np.float64(1.5), "lights": [0, 1]}
    policy = Policy(tmp_path)
    # In the order of the names: force, lights, switches (1 or 2; 0, 1 or 2), tool (2, 3 or 4).
    assert policy.vector(one).tolist() == [1.5, 0, 1, 0, 1, 1, 0, 0, 0, 1, 0]
    action = policy(one)
    assert action.dtype == dtype and -2 <= action[0] <= 4
    assert action[1] == 1 if dtype == "float32" else 1 <= action[1] <= 7


def test_choices_are_counted_from_their_start(tmp_path) -> None:
    model = build("dqn", "scilab_test/Odd-v0", "+env_kwargs.choices=true")
    report = export(model, tmp_path)
    assert report["numpy"] <= TOLERANCE and report["onnx"] <= TOLERANCE
    actions = np.load(tmp_path / "policy.npz")["check.action"]
    assert set(actions) <= {5, 6, 7}


def test_a_relays_flag_is_off_and_a_part_of_the_range_is_used(tmp_path) -> None:
    model = build("jaxsac", GOALS, "algorithm.action_scale_factor=0.5",
                  "algorithm.relay={effector: [0, 1], object: [1, 2]}")  # fmt: skip
    assert export(model, tmp_path)["onnx"] <= TOLERANCE
    contract = json.loads((tmp_path / "contract.json").read_text())
    assert contract["layers"][0]["inputs"] == model.n_observations - 1
    assert contract["action"]["scale"] == [0.5, 0.5] and contract["action"]["offset"] == [0, 0]


@pytest.mark.parametrize(
    ("algorithm", "overrides", "reason"),
    [
        ("random", [f"env={BOX}"], "RANDOM has no network"),
        (
            "ppo",
            ["env=scilab_test/Odd-v0", "+env_kwargs.picture=true", "+env_kwargs.choices=true"],
            "is an image",
        ),
        ("cleansac", [f"env={BOX}", "algorithm.precision=bfloat16"], "bfloat16"),
        ("sac", [f"env={BOX}", "algorithm.use_sde=true"], "its layer Hardtanh"),
        ("crossq", [f"env={BOX}"], "its layer BatchRenorm"),
        (
            "ppo",
            [f"env={BOX}", "+wrappers=[{_target_: stable_baselines3.common.vec_env.VecFrameStack,"
             " n_stack: 2}]"],
            "the vector wrapper VecFrameStack",
        ),
        ("recurrentppo", [f"env={BOX}"], "it is recurrent"),
    ],
)  # fmt: skip
def test_what_cannot_be_described_is_refused_in_one_line(algorithm, overrides, reason) -> None:
    model = build(algorithm, *(word.removeprefix("env=") for word in overrides))
    with closing(model.get_env()), pytest.raises(ConfigError, match=reason) as error:
        describe(model)
    assert str(error.value).startswith("This policy cannot be exported: ")
    assert "\n" not in str(error.value)


def test_own_extractors_and_recurrent_policies_are_refused() -> None:
    from sb3_contrib import RecurrentPPO
    from stable_baselines3 import PPO
    from stable_baselines3.common.torch_layers import FlattenExtractor

    class Doubled(FlattenExtractor):
        def forward(self, observations):
            return 2 * super().forward(observations)

    env = build("ppo", BOX).get_env()
    own = PPO("MlpPolicy", env, policy_kwargs={"features_extractor_class": Doubled})
    with closing(env), pytest.raises(ConfigError, match="its features extractor Doubled"):
        describe(own)
    with pytest.raises(ConfigError, match="it is recurrent"):
        describe(RecurrentPPO("MlpLstmPolicy", env))


def test_a_policy_that_would_act_differently_is_not_written(tmp_path) -> None:
    model = build("cleansac", BOX)
    with closing(model.get_env()):
        description = describe(model)
        observations = draw_observations(model, description, 20, seed=3)
        model.actor.net[0].bias.data += 0.1
        with pytest.raises(ScilabRLError, match="act differently from the agent"):
            write_files(tmp_path, model, description, observations, {})


@pytest.mark.parametrize("activation", ["relu", "tanh", "elu", "leaky_relu", "silu", "none"])
def test_onnx_has_the_same_activations(activation, tmp_path) -> None:
    pytest.importorskip("onnxruntime")
    space = spaces.Box(-100, 100, (2,), np.float32)
    layer = Layer(np.array([[1, 2], [3, -4]], np.float32), np.ones(2, np.float32), activation)
    policy = PolicyDescription(
        [Entry(None, space)], None, [layer], Output(space, np.ones(2), np.zeros(2))
    )
    write_onnx(policy, tmp_path / ONNX_FILE, {"contract": "{}"})
    observations = np.array([[0.5, 0.25], [-1.0, 0.5]], np.float32)
    (tmp_path / "contract.json").write_text(json.dumps(describe_numbers(policy)))
    np.savez(tmp_path / "policy.npz", weight0=layer.weight, bias0=layer.bias)
    expected = [Policy(tmp_path)(one) for one in observations]
    answer = run_onnx(tmp_path / ONNX_FILE, {None: observations})
    assert answer == pytest.approx(np.array(expected), abs=1e-6)
    if activation == "none":  # 0.5 + 0.75 + 1, 1 - 1 + 1; -1 + 1.5 + 1, -2 - 2 + 1
        assert answer.tolist() == [[2.25, 1.0], [1.5, -3.0]]


def test_without_onnx_everything_else_is_written(tmp_path, monkeypatch, caplog) -> None:
    real = builtins.__import__

    def without(name, *rest):
        if name == "onnx":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=r"scilab-rl\[onnx\]"):
        write_onnx(PolicyDescription([], None, [], Output(spaces.Discrete(1))), tmp_path / "x", {})
    report = export(build("cleandqn", CHOICE), tmp_path, n=20)
    assert report["onnx"] is None and not (tmp_path / ONNX_FILE).exists()
    assert Policy(tmp_path).layers and "policy.onnx is left out" in caplog.text


def test_the_command_and_the_runtime_without_our_package(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()
    assert run_command_line(["export", "agent:CartPole", "--policy", "robot"]) == 0
    assert "10,000 observations" in capsys.readouterr().out
    folder = tmp_path / "robot"
    assert {path.name for path in folder.iterdir()} == {
        "contract.json", "parity.json", "policy.npz", "policy.onnx", "run_policy.py",
    }  # fmt: skip
    contract = json.loads((folder / "contract.json").read_text())
    assert contract["control_frequency_hz"] == 50.0 and contract["fingerprint"]
    assert contract["policy"] == {"of": "CartPole", "saved": "finished"}
    code = ("import sys; sys.modules.update(torch=None, scilab_rl=None, onnx=None, jax=None);"
            "import run_policy; sys.exit(run_policy.main())")  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and "as exported" in done.stdout, done.stderr
    again = run_command_line(["export", "agent:CartPole", "--policy", "conf"])
    assert again == 0, "an empty folder may be used"
    (folder / "contract.json").write_text("{}")
    assert run_command_line(["export", "agent:CartPole", "--policy", "robot"]) == 2
    assert "holds something other than a policy" in capsys.readouterr().err
    assert run_command_line(["export", "agent:CartPole", "--policy", "best"]) == 2
    assert "the saved policy is --saved best" in capsys.readouterr().err
