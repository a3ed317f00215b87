"""A zip of Stable-Baselines3 can run any code: only a user's word opens it."""

from __future__ import annotations

import base64
import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from scilab_rl.training.sb3_archives import TRUST_VARIABLE

from .commands import QUICK, TINY, last_run, quiet_environment, scilab_rl

ENV_ID = TINY.partition("=")[2]
SMALL = "algorithm.policy_kwargs={net_arch: [16, 16]}"
UNTOUCHED = (TINY, *QUICK, "n_epochs=1", "algorithm.learning_starts=1000", SMALL,
             "require_updates=false")  # fmt: skip


class Canary:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that somebody trained and saved with plain Stable-Baselines3."""
    path = tmp_path_factory.mktemp("foreign") / "model.zip"
    script = (
        "import sys, gymnasium, scilab_rl.testing\n"
        "from stable_baselines3 import SAC\n"
        f"env = gymnasium.make('{ENV_ID}')\n"
        "model = SAC('MultiInputPolicy', env, seed=5, learning_starts=20, device='cpu',\n"
        "            policy_kwargs={'net_arch': [16, 16]})\n"
        "model.learn(60)\n"
        "model.save(sys.argv[1])\n"
    )
    command = [sys.executable, "-c", script, str(path)]
    subprocess.run(command, check=True, env=quiet_environment(), timeout=120)
    return path


def malicious(archive: Path, canary: Path, folder: Path) -> Path:
    """Return a copy of a good zip with code in its settings and in its weights."""
    import cloudpickle

    code = base64.b64encode(cloudpickle.dumps(Canary(canary))).decode()
    weights = io.BytesIO()
    torch.save({"log_ent_coef": Canary(canary)}, weights)
    path = folder / "malicious.zip"
    with zipfile.ZipFile(archive) as good:
        contents = {name: good.read(name) for name in good.namelist()}
    data = json.loads(contents["data"])
    data["policy_class"] = {":type:": "<class 'abc.ABCMeta'>", ":serialized:": code}
    contents["data"] = json.dumps(data).encode()
    contents["pytorch_variables.pth"] = weights.getvalue()
    with zipfile.ZipFile(path, "w") as bad:
        for name, content in contents.items():
            bad.writestr(name, content)
    return path


def test_the_canary_sings_when_stable_baselines3_loads_it(archive: Path, tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    script = "import sys; from stable_baselines3 import SAC; SAC.load(sys.argv[1])"
    path = malicious(archive, canary, tmp_path)
    command = [sys.executable, "-c", script, str(path)]
    subprocess.run(command, env=quiet_environment(), timeout=120, check=False, capture_output=True)
    assert canary.exists()


@pytest.mark.parametrize("command", ["train", "play"])
def test_without_the_flag_nothing_is_executed(command: str, archive: Path, tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    path = malicious(archive, canary, tmp_path)
    # Even where somebody has left the setting of worker processes in the environment.
    variables = {TRUST_VARIABLE: "1"}
    if command == "train":
        arguments = ["algorithm=sac", *UNTOUCHED, f"+restore_policy={path}"]
    else:
        arguments = ["play", str(path), "algorithm=sac", TINY, SMALL]
    refused = scilab_rl(*arguments, cwd=tmp_path, **variables)
    assert refused.returncode == 2
    (line,) = refused.stderr.strip().splitlines()
    assert str(path) in line
    assert "--trust-pickle" in line
    assert not canary.exists()
    assert not (tmp_path / "data").exists()


def test_with_the_flag_only_the_weights_are_read(archive: Path, tmp_path: Path) -> None:
    """Trust is asked for, and still not used: the settings are skipped, weights are no objects."""
    canary = tmp_path / "canary"
    path = malicious(archive, canary, tmp_path)
    done = scilab_rl(
        "algorithm=sac", *UNTOUCHED, f"+restore_policy={path}", "--trust-pickle", cwd=tmp_path
    )
    assert done.returncode == 1
    assert "does not fit SAC" in done.stderr
    assert not canary.exists()


def test_trusted_weights_are_those_that_were_saved(archive: Path, tmp_path: Path) -> None:
    done = scilab_rl(
        "algorithm=sac", *UNTOUCHED, f"+restore_policy={archive.with_suffix('')}",
        "--trust-pickle", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("as you trust its source") == 1
    from safetensors.numpy import load_file

    # No update happens before learning_starts: the weights are the restored ones.
    tensors = load_file(last_run(tmp_path) / "rl_model_finished" / "tensors.safetensors")
    with zipfile.ZipFile(archive) as opened:
        saved = {
            name: torch.load(io.BytesIO(opened.read(name)), weights_only=True)
            for name in ("policy.pth", "pytorch_variables.pth")
        }
    for name, value in saved["policy.pth"].items():
        np.testing.assert_array_equal(tensors[f"algorithm.policy.{name}"], value.numpy(), name)
    log_ent_coef = saved["pytorch_variables.pth"]["log_ent_coef"].detach().numpy()
    np.testing.assert_array_equal(tensors["algorithm.log_ent_coef"], log_ent_coef)


def test_play_measures_a_trusted_policy(archive: Path, tmp_path: Path) -> None:
    done = scilab_rl(
        "play", str(archive), "algorithm=sac", TINY, SMALL, "--episodes", "3", "--trust-pickle",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "episodes: 3" in done.stdout


WRONG = [
    (("play", "ARCHIVE", "--trust-pickle"), "algorithm=sac env=FetchReach --trust-pickle"),
    (("play", "ARCHIVE", "algorithm=cleansac", TINY, "--trust-pickle"), "one-file algorithm"),
    (("play", "nowhere.zip", "--trust-pickle"), "No run 'nowhere.zip'"),
    (("play", "last", "algorithm=sac"), "a run keeps its configuration"),
    (("algorithm=sac", TINY, "restore_policy=nowhere.zip"), "no saved policy in 'nowhere.zip'"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_what_cannot_be_is_refused(
    arguments: tuple[str, ...],
    message: str,
    archive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from scilab_rl.cli.main import run_command_line

    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(os.environ, TRUST_VARIABLE, "0")
    code = run_command_line([word.replace("ARCHIVE", str(archive)) for word in arguments])
    assert code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_networks_of_another_size_do_not_fit(archive: Path, tmp_path: Path) -> None:
    done = scilab_rl("play", str(archive), "algorithm=sac", TINY, "--trust-pickle", cwd=tmp_path)
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert "does not fit SAC with these settings" in line
