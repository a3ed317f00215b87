"""Files and names that somebody made to do harm: nothing of theirs is ever executed or followed."""

from __future__ import annotations

import base64
import http.client
import io
import json
import os
import pickle
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from scilab_rl.cli.main import run_command_line
from scilab_rl.recording.live import free_port
from scilab_rl.redaction import redact
from scilab_rl.run.directory import RunDirectory, find_run, slug
from scilab_rl.telemetry import SWITCHES

from ..e2e.commands import ROOT, command, quiet_environment
from .harness import ENV, RANDOM, last_run, scilab_rl, wait_until

SECRET = "hunter2-correct-horse"


class Canary:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    done = scilab_rl("algorithm=cleansac", ENV, "n_epochs=1", "eval_after_n_steps=40",
                     "n_test_rollouts=1", "mlflow=0", "tuned=false", "save_model_freq=20",
                     "require_updates=false", "algorithm.net_arch=[8]",
                     "algorithm.buffer_size=200", cwd=folder)  # fmt: skip
    assert done.code == 0, done.errors
    return folder


@pytest.fixture
def project(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a finished run that a test may spoil."""
    shutil.copytree(finished / "data", tmp_path / "data", symlinks=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def zip_of(path: Path, contents: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return path


def saved_by_torch(value: object) -> bytes:
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


def payloads(canary: Path) -> dict[str, dict[str, bytes]]:
    """Return what each of eight attackers puts into the folder of a run, file name to content."""
    plain = pickle.dumps(Canary(canary))
    objects = io.BytesIO()
    np.save(objects, np.array([Canary(canary)], dtype=object), allow_pickle=True)
    archive = io.BytesIO()
    np.savez(archive, weights=np.array([Canary(canary)], dtype=object))
    settings = {"policy_class": {":serialized:": base64.b64encode(plain).decode()}}
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as model:
        model.writestr("data", json.dumps(settings))
        model.writestr("policy.pth", saved_by_torch({"weight": Canary(canary)}))
    return {
        "pickle as tensors": {"rl_model_finished/tensors.safetensors": plain},
        "torch as tensors": {"rl_model_finished/tensors.safetensors": saved_by_torch(
            Canary(canary))},
        "objects as array": {"rl_model_finished/arrays/0.npy": objects.getvalue()},
        "archive of objects as array": {"rl_model_finished/arrays/0.npy": archive.getvalue()},
        "pickle as array": {"rl_model_finished/arrays/0.npy": plain},
        "pickle as state": {"rl_model_finished/state.json": plain},
        "zip instead of the folder": {"rl_model_finished.zip": zipped.getvalue()},
        "replay buffer beside it": {"rl_model_finished/replay_buffer.pkl": plain,
                                    "rl_model_finished/model.joblib": plain},
    }  # fmt: skip


PAYLOADS = list(payloads(Path()))


def with_honest_manifest(directory: Path) -> None:
    """Let the manifest say of the changed files what is true of them: checksums protect nobody."""
    import hashlib

    path = directory / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["files"] = {
        str(file.relative_to(directory)): {
            "bytes": file.stat().st_size,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        for file in directory.rglob("*")
        if file.is_file() and file != path
    }
    path.write_text(json.dumps(manifest))


@pytest.mark.parametrize("name", PAYLOADS)
def test_f30_no_pickle_is_executed(
    name: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = last_run(project)
    canary = project / "canary"
    for policy in ("rl_model_best", "rl_model_finished"):
        for file, content in payloads(canary)[name].items():
            (run / file.replace("rl_model_finished", policy)).write_bytes(content)
        if "zip" in name:
            shutil.rmtree(run / policy)
        else:
            with_honest_manifest(run / policy)
    for checkpoint in run.glob("checkpoints/step_*"):
        for file in ("tensors.safetensors", "state.json"):
            content = payloads(canary)["pickle as tensors"].values()
            (checkpoint / file).write_bytes(next(iter(content)))
        with_honest_manifest(checkpoint)
    policy = str(run / "rl_model_finished")
    harmless = name == "replay buffer beside it"  # nobody reads it
    for arguments in (
        ["play", "last", "--episodes", "1"],
        ["play", policy, "--episodes", "1"],
        ["resume", "last"],
        ["runs"],
        ["algorithm=cleansac", ENV, "n_epochs=1", "eval_after_n_steps=1", "mlflow=0",
         "require_updates=false", "algorithm.net_arch=[8]", "n_test_rollouts=1", "tuned=false",
         f"restore_policy={policy}"],
    ):  # fmt: skip
        code = run_command_line(arguments)
        errors = capsys.readouterr().err
        assert not canary.exists(), arguments
        assert "Traceback" not in errors
        if arguments[0] != "runs" and not harmless:
            assert code in (1, 2), (arguments, errors)
    if "zip" in name:
        assert "--trust-pickle" in errors


CONFIGURATIONS = {
    "target": ("algorithm", {"_target_": "os.system", "command": "touch canary"}),
    "target of a wrapper": ("wrappers", [{"_target_": "subprocess.run", "args": "touch canary"}]),
    "target in arguments": ("env_kwargs", {"x": {"_target_": "os.mkdir", "path": "canary"}}),
    "target in a trusted module": (
        "wrappers", [{"_target_": "scilab_rl.cli.os.mkdir", "path": "canary"}]),
    "secret of the environment": ("info", "${oc.env:PLANTED_TOKEN}"),
    "decoding": ("info", "${oc.decode:${oc.env:PLANTED_TOKEN}}"),
    "object of python": ("info", "PYTHON"),
    "get_method": (
        "wrappers", [{"_target_": "hydra.utils.get_method", "path": "os.system"}]),
    "module of the environment": ("env", "planted_canary:TinyReach-v0"),
    "module of an environment inside": ("env_kwargs", {"inner": "planted_canary:TinyReach-v0"}),
    "function of a network": ("algorithm", {"name": "sac", "_target_": "stable_baselines3.SAC",
        "policy_kwargs": {"activation_fn": "planted_canary.Relu"}}),
    "optimizer": ("algorithm", {"name": "sac", "_target_": "stable_baselines3.SAC",
        "policy_kwargs": {"optimizer_class": {"_target_": "planted_canary.Adam"}}}),
    "replay buffer": ("algorithm", {"name": "sac", "_target_": "stable_baselines3.SAC",
        "replay_buffer_class": "planted_canary.Buffer"}),
    "policy": ("algorithm", {"name": "sac", "_target_": "stable_baselines3.SAC",
        "policy": "planted_canary.Policy"}),
    "tracker": ("tracking", {"console": {"_target_": "planted_canary.Tracker", "enabled": True}}),
}  # fmt: skip


@pytest.mark.parametrize("name", CONFIGURATIONS)
@pytest.mark.parametrize(
    "arguments",
    [
        ("play", "last", "--episodes", "1"),
        ("resume", "last"),
        ("export", "last", "--episodes", "1"),
        ("probe", "last", "--metrics", "q_value"),
    ],
    ids=lambda words: words[0],
)
def test_f31_configuration_of_a_run_is_data(
    name: str,
    arguments: tuple[str, ...],
    project: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from omegaconf import OmegaConf

    monkeypatch.setenv("PLANTED_TOKEN", SECRET)
    plant_canary(project, monkeypatch)
    path = last_run(project) / "config.yaml"
    key, value = CONFIGURATIONS[name]
    cfg = OmegaConf.load(path)
    cfg[key] = value
    text = OmegaConf.to_yaml(cfg)
    path.write_text(
        text.replace("PYTHON", "!!python/object/apply:os.mkdir [canary]"), encoding="utf-8"
    )
    assert run_command_line(list(arguments)) == 2
    captured = capsys.readouterr()
    assert re.fullmatch(r"error: .+\n", captured.err), captured.err
    assert SECRET not in captured.out + captured.err
    assert not (project / "canary").exists()
    assert "config.yaml" in captured.err


def plant_canary(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a module on Python's path that leaves a file and registers an environment."""
    (project / "planted_canary.py").write_text(
        "from pathlib import Path\nimport gymnasium as gym\n"
        "Path('canary').touch()\n"
        "gym.register('Planted-v0', 'scilab_rl.testing.environments:TinyReach', "
        "max_episode_steps=15)\n"
    )
    monkeypatch.syspath_prepend(str(project))
    monkeypatch.delitem(sys.modules, "planted_canary", raising=False)


def test_f31_module_of_a_recorded_environment_is_confirmed_by_its_name(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plant_canary(project, monkeypatch)
    path = last_run(project) / "config.yaml"
    path.write_text(re.sub(r"(?m)^env: .*", "env: planted_canary:Planted-v0", path.read_text()))
    words = ["play", "last", "--episodes", "1"]
    assert run_command_line(words) == 2
    assert "add --trust-module=planted_canary." in capsys.readouterr().err
    assert run_command_line([*words, "--trust-module=another"]) == 2
    assert run_command_line([*words, "--trust-module"]) == 2
    assert not (project / "canary").exists()
    assert run_command_line([*words, "--trust-module=planted_canary"]) == 0
    assert (project / "canary").exists()
    monkeypatch.delitem(sys.modules, "planted_canary")
    assert run_command_line(words) == 2  # trust is for one command


def test_f31_modules_of_the_project_folder_and_of_plug_ins_need_no_confirmation(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from importlib import metadata

    from scilab_rl.config.recorded import refuse_untrusted_modules

    plug_in = metadata.EntryPoint("__root__", "my_plug_in.envs:register", "gymnasium.envs")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [plug_in])
    for module in ("custom_envs", "custom_envs.mine", "my_plug_in.envs", "scilab_rl.testing"):
        refuse_untrusted_modules({"env": f"{module}:Id-v0"}, project)
    typed = "typed_by_the_user:Id-v0"
    refuse_untrusted_modules({"env": typed}, project, typed_env=typed)


def test_f31_recorded_places_are_not_written_to(project: Path, tmp_path: Path) -> None:
    """A resumed run stays where it lies, and its view on this machine."""
    from scilab_rl.config.recorded import load_recorded

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    path = last_run(project) / "config.yaml"
    text = re.sub(r"(?m)^base_logdir: .*", f"base_logdir: {elsewhere}", path.read_text())
    path.write_text(re.sub(r"(?m)^viewer_host: .*", "viewer_host: 0.0.0.0", text))
    assert load_recorded(path).viewer_host == "127.0.0.1"
    assert load_recorded(path, ["viewer_host=0.0.0.0"]).viewer_host == "0.0.0.0"
    assert run_command_line(["resume", "last", "n_epochs=2"]) == 0
    assert list(elsewhere.iterdir()) == []


def test_f31_what_the_user_types_is_his_own_choice(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run_command_line(["algorithm._target_=os.system", ENV, "mlflow=0"])
    assert code == 2  # it is no class, so it is not called
    assert "Traceback" not in capsys.readouterr().err


HOSTILE = [
    "../x", "../../x", "/etc/x", "a/../../b", "~", "~/x", ".", "..", "...", "", " ", "a\0b", "a\nb",
    "%2e%2e%2fx", "x" * 300, "CON", "\u202eexe.gpj", "-rf", "$(touch x)", "`touch x`", "a;touch x",
    "'", '"', "a\\..\\b", "\x1b[31mred", "*", "?", "|x", "<x>", "a:b", "\uff0e\uff0e\uff0fx",
]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_f32_hostile_names_stay_inside(name: str, tmp_path: Path) -> None:
    base = tmp_path / "base"
    run = RunDirectory.create(base, name, name, 1)
    assert run.path.resolve().is_relative_to(base.resolve())
    assert run.path.parent.parent == base
    assert re.fullmatch(r"[A-Za-z0-9._-]+", run.path.name)
    assert len(run.path.name) < 255
    assert not slug(name).startswith((".", "-"))
    assert sorted(tmp_path.iterdir()) == [base]


TYPED = [name for name in HOSTILE if name.isprintable() and not set(name) & set("'\"$`\\*?|<>;")]


@pytest.mark.parametrize("key", ["env", "group"])
def test_f32_hostile_names_as_values(
    key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    give_names(key, TYPED[::3], tmp_path, monkeypatch, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["env", "project_name", "group", "info"])
def test_f32_all_hostile_names_as_values(
    key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    give_names(key, TYPED, tmp_path, monkeypatch, capsys)


def give_names(
    key: str,
    names: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "deep" / "project"
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    for name in names:
        rest = [word for word in RANDOM if not word.startswith((key, "n_epochs", "eval_after"))]
        code = run_command_line([*rest, f"{key}='{name}'", "n_epochs=0"])
        assert code == 2, name
        assert "Traceback" not in capsys.readouterr().err
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("name", [n for n in HOSTILE if "\0" not in n])
def test_f32_hostile_runs_to_look_at(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "project"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for words in (["play", "--", name], ["resume", "--", name], ["view", "--", name]):
        code = run_command_line(words)
        assert code in (1, 2), words
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        assert "\x1b" not in captured.err
    assert list(folder.iterdir()) == []


def test_f32_linked_run_is_not_listed_twice_and_not_cleaned(project: Path) -> None:
    run = last_run(project)
    (run.parent / "link").symlink_to("/etc")
    (project / "data" / "2020-01-01").symlink_to(run.parent)
    listed = scilab_rl("runs", "--json", cwd=project)
    assert len(json.loads(listed.output)) == 1
    assert "/etc" not in scilab_rl("clean", cwd=project).output


@pytest.mark.parametrize("member", ["../outside", "/tmp/outside-of-all", "a/../../outside"])
def test_f32_archives_are_never_unpacked(
    member: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A zip of Stable-Baselines3 is read member by member, by names of ours."""
    path = zip_of(project / "model.zip", {member: b"x", "data": b"{}", "policy.pth": b"x"})
    code = run_command_line(
        ["play", str(path), "algorithm=sac", ENV, "--episodes", "1", "--trust-pickle"]
    )
    assert code in (1, 2)
    assert "Traceback" not in capsys.readouterr().err
    assert not list(project.rglob("outside*"))
    assert not list(project.parent.glob("outside*"))
    assert not Path("/tmp/outside-of-all").exists()


def test_f32_manifest_that_names_files_elsewhere(project: Path) -> None:
    """Checksums of somebody's files must not be compared for an attacker."""
    from scilab_rl.errors import CheckpointError
    from scilab_rl.training import checkpoint

    directory = last_run(project) / "rl_model_finished"
    manifest = json.loads((directory / "manifest.json").read_text())
    for name in ("/etc/passwd", "../config.yaml", "arrays/../../config.yaml"):
        changed = manifest | {"files": manifest["files"] | {name: {"bytes": 1, "sha256": "x"}}}
        (directory / "manifest.json").write_text(json.dumps(changed))
        with pytest.raises(CheckpointError, match="is missing"):
            checkpoint.load(directory)


def listeners_of(pids: set[int]) -> Iterator[tuple[str, int]]:
    """Yield address and port of each listening socket of these processes, from /proc."""
    inodes = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                found = re.fullmatch(r"socket:\[(\d+)\]", str(link.readlink()))
            except OSError:
                continue
            if found:
                inodes.add(found[1])
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and words[9] in inodes:
                address, port = words[1].split(":")
                yield address, int(port, 16)


def tree_of(pid: int) -> set[int]:
    """Return a process and all that it or one of its threads has started."""
    found = {pid}
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in children.read_text().split():
            found |= tree_of(int(child))
    return found


LOOPBACK = ("0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F")


@pytest.mark.parametrize(
    "more", [(), ("n_envs=2", "vector=subprocess"), ("render=display", "render_freq=1")]
)
def test_f33_training_listens_to_this_machine_only(more: tuple[str, ...], tmp_path: Path) -> None:
    endless = ("algorithm=random", ENV, "n_epochs=100000", "eval_after_n_steps=40",
               "n_test_rollouts=1", "mlflow=0", "tuned=false", *more)  # fmt: skip
    process = subprocess.Popen(
        command(*endless), cwd=tmp_path, env=quiet_environment(PYTHONPATH=str(ROOT)),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        wait_until(lambda: list(tmp_path.glob("data/*/*/metrics.csv")), 120)
        time.sleep(1)
        listening = list(listeners_of(tree_of(process.pid)))
        assert [address for address, _ in listening if address not in LOOPBACK] == []
        if not more:
            assert listening == []
    finally:
        process.terminate()
        process.wait(60)


def test_f35_secrets_are_masked_wherever_something_is_written(tmp_path: Path) -> None:
    done = scilab_rl(
        *RANDOM,
        "n_epochs=1",
        f"info='my key is {SECRET}'",
        "project_name=${oc.env:WANDB_API_KEY}",
        "tracking.mlflow.tracking_uri='postgresql://ada:lovelace@127.0.0.1/runs'",
        "+env_kwargs.api_key=abcdef123456",
        cwd=tmp_path,
        variables={"WANDB_API_KEY": SECRET, "MLFLOW_TRACKING_PASSWORD": "pass-word-pass"},
    )
    assert done.code in (0, 2)
    texts = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    texts[Path("output")] = (done.output + done.errors).encode()
    for path, text in texts.items():
        for secret in (SECRET, "lovelace", "abcdef123456"):
            assert secret.encode() not in text, path


def test_f35_errors_are_masked_too(tmp_path: Path) -> None:
    done = scilab_rl(
        *RANDOM, "env_kwargs.fault=raise", f"env_kwargs.nothing={SECRET}", cwd=tmp_path,
        variables={"MY_TOKEN": SECRET},
    )  # fmt: skip
    assert done.code == 2
    assert SECRET not in done.errors


@pytest.mark.parametrize(
    ("text", "masked"),
    [
        ("mysql://u:p@host/db", "mysql://***@host/db"),
        ("http://host:5000/path", "http://host:5000/path"),
        ("https://u@host", "https://u@host"),
        ("password=abc", "password=***"),
        ('"api_key": "abc"', '"api_key": "***"'),
        ("auth_token: abc", "auth_token: ***"),
        ("api_key: null", "api_key: null"),
        ("n_tokens: 5", "n_tokens: 5"),
        ("keys: 5", "keys: 5"),
        ("pad_token: 0", "pad_token: 0"),
        ("goal_key: observation_of_object_2", "goal_key: observation_of_object_2"),
        ("password:\n  - next", "password:\n  - next"),
        ("password: str | None = None", "password: *** | None = None"),
        ("+key = jax.random.PRNGKey(0)", "+key = jax.random.PRNGKey(0)"),
        (f"index {'0a' * 20}..", f"index {'0a' * 20}.."),
        ('+password: str = "correct horse"', '+password: str = "***"'),
        ('+def log_in(password="a b", n=1):', '+def log_in(password="***", n=1):'),
        ('+password = f"a{b}c"', "+password = ***"),
        ('+if password == "abc":', '+if password == "***":'),
        ('+os.environ["MY_API_KEY"] = "abc"', '+os.environ["MY_API_KEY"] = "***"'),
        ("+AWS_SECRET_ACCESS_KEY=abc/def", "+AWS_SECRET_ACCESS_KEY=***"),
        (f"+wandb.login(key='{'0a' * 20}')", "+wandb.login(key='***')"),
        (f"+  token: {'0a' * 10}", "+  token: ***"),
        (f"+push('ghp_{'0a' * 15}')", "+push('***')"),
        ("-----BEGIN PRIVATE KEY-----\n+0a\n+-----END PRIVATE KEY-----",
         "-----BEGIN PRIVATE KEY-----***-----END PRIVATE KEY-----"),
    ],
)  # fmt: skip
def test_f35_what_is_masked_and_what_is_not(text: str, masked: str) -> None:
    assert redact(text) == masked
    assert redact(masked) == masked


def test_f35_changed_code_is_kept_without_its_secrets(tmp_path: Path) -> None:
    def git(*arguments: str) -> None:
        who = ("-c", "user.name=me", "-c", "user.email=me@localhost")
        subprocess.run(["git", *who, *arguments], cwd=tmp_path, check=True, capture_output=True)

    code = tmp_path / "upload.py"
    code.write_text("PASSWORD = 'of-yesterday'\nSPEED = 1\n")
    git("init", "--quiet")
    git("add", "upload.py")
    git("commit", "--quiet", "-m", "first")
    code.write_text(
        f"PASSWORD = 'of today'\nSPEED = 2\nlog_in(token='{'0a' * 20}')\n"
        f"SERVER = 'http://ada:lovelace@localhost'\nPLANTED = '{SECRET}'\n"
    )
    done = scilab_rl(*RANDOM, "n_epochs=1", cwd=tmp_path, variables={"MY_TOKEN": SECRET})
    assert done.code == 0, done.errors
    changes = (last_run(tmp_path) / "git.diff").read_text().splitlines()
    assert [line for line in changes if re.match(r"[+-](?![+-])", line)] == [
        "-PASSWORD = '***'",
        "-SPEED = 1",
        "+PASSWORD = '***'",
        "+SPEED = 2",
        "+log_in(token='***')",
        "+SERVER = 'http://***@localhost'",
        "+PLANTED = '***'",
    ]


def test_f35_values_of_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GITHUB_TOKEN", "ghp_0123456789")
    monkeypatch.setenv("SHORT_TOKEN", "data")  # an ordinary word
    assert redact("with ghp_0123456789 in data") == "with *** in data"


def test_f31_secrets_of_the_environment_are_not_written(tmp_path: Path) -> None:
    done = scilab_rl(*RANDOM, "n_epochs=1", "info=x", cwd=tmp_path,
                     variables={"PLANTED_SECRET": SECRET})  # fmt: skip
    assert done.code == 0, done.errors
    for path in tmp_path.rglob("*"):
        assert not path.is_file() or SECRET.encode() not in path.read_bytes()


def test_f30_find_run_never_opens_what_it_finds(tmp_path: Path) -> None:
    from scilab_rl.errors import ConfigError

    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "data.pkl").write_bytes(pickle.dumps(Canary(tmp_path / "canary")))
    with pytest.raises(ConfigError):
        find_run("x", tmp_path)
    assert not (tmp_path / "canary").exists()


def test_no_pickle_is_read_in_the_package() -> None:
    """The words that read a pickle occur where they are explained, and nowhere else."""
    allowed = {"envs/checker.py", "learning/goal_functions.py"}  # their own, of a moment ago
    reading = re.compile(r"pickle\.loads?\(|torch\.load\(|joblib\.load|allow_pickle=True")
    found = {
        str(path.relative_to(ROOT / "src" / "scilab_rl"))
        for path in (ROOT / "src" / "scilab_rl").rglob("*.py")
        if reading.search(path.read_text(encoding="utf-8"))
    }
    assert found <= allowed, found
    assert sys.version_info >= (3, 10)


@pytest.fixture(scope="module")
def viewed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a page that `scilab-rl view` serves."""
    with viewing(tmp_path_factory.mktemp("viewed")) as (_, port):
        yield port


@contextmanager
def viewing(folder: Path) -> Iterator[tuple[subprocess.Popen, int]]:
    """Run `scilab-rl view RUN --browser` without a display; yields it, and its port."""
    episodes = folder / "data" / "2026-01-02" / "run" / "episodes"
    (episodes / "folder").mkdir(parents=True)
    (episodes / "page.npz").touch()
    # Larger than what the kernel takes from a server whose client does not read.
    (episodes / "page.html").write_text(f"<html>{' ' * 50_000_000}</html>")
    (episodes.parent / "config.yaml").touch()
    with started("view", "run", "--browser", cwd=folder) as (process, said):
        yield process, int(wait_for(r"Open http://127\.0\.0\.1:(\d+)/page\.html", said)[1])


@contextmanager
def started(
    *arguments: str, cwd: Path, program: tuple[str, ...] = (), **variables: str
) -> Iterator[Any]:
    """Run a command line beside the test, without a display; yields it, and where it writes."""
    said = cwd / "said"
    environment = quiet_environment(
        PYTHONPATH=str(ROOT), DISPLAY="", WAYLAND_DISPLAY="", **variables
    )
    with said.open("wb") as file:
        process = subprocess.Popen(
            [*program, *arguments] if program else command(*arguments),
            cwd=cwd, env=environment, stdout=file, stderr=file, start_new_session=True,
        )  # fmt: skip
    try:
        yield process, said
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(60)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def wait_for(pattern: str, said: Path) -> re.Match[str]:
    """Wait until a process has written something."""
    wait_until(lambda: re.search(pattern, said.read_text(errors="replace")), 120)
    found = re.search(pattern, said.read_text(errors="replace"))
    assert found
    return found


class Answer(NamedTuple):
    """What a server has answered: status, headers, and the beginning of what it has sent."""

    status: int
    headers: dict[str, str]
    begin: bytes


def ask(
    port: int, path: str, headers: dict[str, str], *, method: str = "GET", body: bytes | None = None
) -> Answer:
    """Send a request in which headers are exactly as given."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.putrequest(method, path, skip_host=True)
    for name, value in headers.items():
        connection.putheader(name, value.format(port=port))
    if body is not None:
        connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(body)
    answer = connection.getresponse()
    sent = {name.lower(): value for name, value in answer.getheaders()}
    found = Answer(answer.status, sent, answer.read1(1000))
    connection.close()
    return found


@contextmanager
def slow_client(port: int, request: bytes) -> Iterator[None]:
    """Ask for something large and read one byte of the answer per second."""
    has_ended = threading.Event()

    def read() -> None:
        while not has_ended.wait(1.0):
            client.recv(1)

    with socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", port))
        client.sendall(request)
        assert client.recv(1)  # it is being served
        reading = threading.Thread(target=read)
        reading.start()
        try:
            yield
        finally:
            has_ended.set()
            reading.join()


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("GET", "/page.html", {"Host": "127.0.0.1:{port}"}, 200),
        ("GET", "/page.html", {"Host": "localhost:{port}"}, 200),
        ("GET", "/page.html", {"Host": "[::1]:{port}"}, 200),
        ("GET", "/page.html", {"Host": "localhost", "Origin": "http://localhost:{port}"}, 200),
        ("GET", "/page.html", {"Host": "attacker.example"}, 403),
        ("GET", "/page.html", {"Host": "localhost.attacker.example:{port}"}, 403),
        ("GET", "/page.html", {"Host": "localhost@attacker.example"}, 403),
        ("GET", "/page.html", {"Host": ""}, 403),
        ("GET", "/page.html", {"Host": "[::bad"}, 403),
        ("GET", "/page.html", {"Host": "localhost", "Origin": "https://attacker.example"}, 403),
        ("GET", "/page.html", {"Host": "localhost", "Origin": "null"}, 403),
        ("GET", "/", {"Host": "localhost"}, 404),
        ("GET", "/folder/", {"Host": "localhost"}, 404),
        ("GET", "/../../../../etc/passwd", {"Host": "localhost"}, 404),
        ("GET", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", {"Host": "localhost"}, 404),
        ("POST", "/page.html", {"Host": "localhost"}, 501),
        ("DELETE", "/page.html", {"Host": "localhost"}, 501),
    ],
)
def test_f34_pages_for_this_machine_alone(
    method: str, path: str, headers: dict[str, str], status: int, viewed: int
) -> None:
    assert ask(viewed, path, headers, method=method).status == status


def test_f34_slow_clients_block_nobody_and_end_with_the_server(tmp_path: Path) -> None:
    request = b"GET /page.html HTTP/1.0\r\nHost: localhost\r\n\r\n"
    with viewing(tmp_path) as (process, port):
        with slow_client(port, request), slow_client(port, request):
            assert ask(port, "/page.html", {"Host": "localhost"}).begin.startswith(b"<html>")
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 130


READ_LIVE_DATA = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
GRPC_WEB = {"Content-Type": "application/grpc-web+proto", "X-Grpc-Web": "1"}
NO_MESSAGE = bytes(5)  # the frame of an empty message


@pytest.fixture
def shown(tmp_path: Path) -> Iterator[tuple[subprocess.Popen, int, int]]:
    """A training with a live view in the browser; the ports of its page and of its data."""
    pytest.importorskip("rerun")
    endless = ("algorithm=random", ENV, "n_epochs=100000", "eval_after_n_steps=40",
               "n_test_rollouts=1", "mlflow=0", "tuned=false", "render=display",
               "render_freq=1")  # fmt: skip
    with started(*endless, cwd=tmp_path) as (process, said):
        found = wait_for(r"Live view: http://127\.0\.0\.1:(\d+)/\?url=.*%3A(\d+)%2Fproxy", said)
        wait_until(lambda: list(tmp_path.glob("data/*/*/metrics.csv")), 120)
        yield process, int(found[1]), int(found[2])


def test_f34_live_data_are_not_for_pages_from_elsewhere(shown: Any) -> None:
    """The server is Rerun's. A browser gives its answers to pages of this machine only."""
    _, page_port, data_port = shown
    asked = {"Access-Control-Request-Method": "POST",
             "Access-Control-Request-Headers": "content-type,x-grpc-web"}  # fmt: skip
    allowed = {}
    for origin in ("https://attacker.example", "http://localhost.attacker.example", "null",
                   f"http://127.0.0.1:{page_port}"):  # fmt: skip
        told = {"Host": "127.0.0.1:{port}", "Origin": origin}
        for method, more, body in (("OPTIONS", asked, None), ("POST", GRPC_WEB, NO_MESSAGE)):
            answer = ask(data_port, READ_LIVE_DATA, told | more, method=method, body=body)
            assert answer.status == 200
            allowed[origin, method] = answer.headers.get("access-control-allow-origin")
    own = f"http://127.0.0.1:{page_port}"
    assert {key: value for key, value in allowed.items() if value is not None} == {
        (own, "OPTIONS"): own,
        (own, "POST"): own,
    }


def test_f34_slow_clients_of_the_live_view_delay_neither_training_nor_its_end(
    shown: Any, tmp_path: Path
) -> None:
    process, page_port, data_port = shown
    (metrics,) = tmp_path.glob("data/*/*/metrics.csv")
    headers = "".join(f"{name}: {value}\r\n" for name, value in GRPC_WEB.items())
    for_data = f"POST {READ_LIVE_DATA} HTTP/1.1\r\nHost: localhost\r\n{headers}"
    for_page = b"GET /re_viewer_bg.wasm HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with slow_client(data_port, f"{for_data}Content-Length: 5\r\n\r\n".encode() + NO_MESSAGE):
        with slow_client(page_port, for_page):
            told = {"Host": "localhost"} | GRPC_WEB
            answer = ask(data_port, READ_LIVE_DATA, told, method="POST", body=NO_MESSAGE)
            assert answer.status == 200
            written = metrics.stat().st_size
            wait_until(lambda: metrics.stat().st_size > written)
            process.send_signal(signal.SIGTERM)
            assert process.wait(30) == 143


@pytest.fixture(scope="module")
def mlflow_ui(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[subprocess.Popen, int]]:
    """What `make mlflow` starts, with a port of its own; yields the process and the port."""
    pytest.importorskip("mlflow")
    (told,) = re.findall(r"^\t\$\(BIN\)/mlflow (ui .*)$", (ROOT / "Makefile").read_text(), re.M)
    port = free_port(15_000)
    arguments = re.sub(r"--port \d+", f"--port {port} --workers 1", told).split()
    folder = tmp_path_factory.mktemp("mlflow")
    (folder / "data").mkdir()
    (folder / "home").mkdir()
    variables = exported_by_make() | {"HOME": str(folder / "home")}
    program = (sys.executable, "-m", "mlflow")
    with started(*arguments, cwd=folder, program=program, **variables) as (process, _):
        wait_until(
            lambda: port in (number for _, number in listeners_of(tree_of(process.pid))), 120
        )
        yield process, port


def exported_by_make() -> dict[str, str]:
    """Return the variables that `make` gives to the programs of its targets."""
    told = subprocess.run(
        ["make", "--silent", "--eval", "show-variables: ; @env", "show-variables"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    words = dict(line.partition("=")[::2] for line in told.splitlines())
    return {name: words[name] for name in SWITCHES if name in words and name not in os.environ}


def test_f33_make_and_the_command_line_switch_telemetry_off(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in SWITCHES:
        monkeypatch.delenv(name, raising=False)
    assert exported_by_make() == {
        name: SWITCHES[name] for name in ("DO_NOT_TRACK", "MLFLOW_DISABLE_TELEMETRY")
    }
    monkeypatch.setenv("DO_NOT_TRACK", "false")  # somebody's own wish
    assert run_command_line(["runs"]) == 0
    assert {name: os.environ.get(name) for name in SWITCHES} == SWITCHES | {"DO_NOT_TRACK": "false"}
    for name in SWITCHES:
        monkeypatch.delenv(name)


@pytest.mark.slow
def test_f33_mlflow_ui_leaves_nothing_in_the_home_folder(mlflow_ui: Any) -> None:
    """Its telemetry begins with a number for this installation, in ``~/.config/mlflow``."""
    process, _ = mlflow_ui
    words = Path(f"/proc/{process.pid}/environ").read_bytes().split(b"\0")
    (home,) = (Path(word[5:].decode()) for word in words if word.startswith(b"HOME="))
    assert [path for path in home.rglob("*") if path.is_file()] == []


@pytest.mark.slow
def test_f33_mlflow_ui_listens_to_this_machine_only(mlflow_ui: Any) -> None:
    process, port = mlflow_ui
    listening = list(listeners_of(tree_of(process.pid)))
    assert port in [number for _, number in listening]
    assert [address for address, _ in listening if address not in LOOPBACK] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "127.0.0.1:{port}"}, 200),
        ({"Host": "attacker.example"}, 403),
        ({"Host": "localhost:{port}", "Origin": "https://attacker.example"}, 403),
    ],
)
def test_f34_mlflow_ui_refuses_pages_from_elsewhere(
    headers: dict[str, str], status: int, mlflow_ui: Any
) -> None:
    path, body = "/api/2.0/mlflow/experiments/search", b'{"max_results": 1}'
    told = headers | {"Content-Type": "application/json"}
    assert ask(mlflow_ui[1], path, told, method="POST", body=body).status == status


@pytest.mark.slow
def test_f33_dashboard_of_a_study_listens_to_this_machine_only(tmp_path: Path) -> None:
    pytest.importorskip("optuna_dashboard")
    import optuna

    study = tmp_path / "data" / "studies" / "mine"
    study.mkdir(parents=True)
    (study / "study.yaml").write_text("sweeper: {storage: null}\n")
    optuna.create_study(storage=f"sqlite:///{study / 'study.db'}", study_name="mine")
    port = free_port(16_000)
    arguments = ("study", "mine", "--dashboard", "--port", str(port))
    with started(*arguments, cwd=tmp_path) as (process, _):
        wait_until(lambda: list(listeners_of(tree_of(process.pid))), 120)
        listening = list(listeners_of(tree_of(process.pid)))
        assert port in [number for _, number in listening]
        assert [address for address, _ in listening if address not in LOOPBACK] == []
