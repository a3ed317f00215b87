"""Clocks, terminals, locales, missing packages, other versions: what differs between machines."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from scilab_rl.run.directory import RunDirectory

from ..e2e.commands import ROOT, command, quiet_environment
from .harness import RANDOM, last_run, result_of, runs_in, scilab_rl


def test_f36_fifty_starts_in_the_same_second(tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from scilab_rl.run.directory import RunDirectory\n"
        "for _ in range(25): print(RunDirectory.create(Path(sys.argv[1]), 'E', 'a', 1))"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE,
                         text=True)
        for _ in range(2)
    ]  # fmt: skip
    paths = [line for process in processes for line in process.communicate()[0].splitlines()]
    assert len(paths) == len(set(paths)) == 50


def test_f37_clock_that_jumps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each look at the clock finds it an hour earlier: durations come from another one."""
    jumps = iter(range(0, -10_000_000, -3600))
    now = time.time()
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: now + next(jumps))
        patch.chdir(tmp_path)
        from scilab_rl.cli.main import run_command_line

        assert run_command_line(list(RANDOM)) == 0
    result = result_of(last_run(tmp_path))
    assert 0 < result["seconds"] < 120
    for row in (last_run(tmp_path) / "metrics.jsonl").read_text().splitlines():
        values = json.loads(row)
        assert all(v >= 0 for k, v in values.items() if k.startswith("time/"))


@pytest.mark.parametrize("zone", ["UTC", "Pacific/Kiritimati", "America/Adak"])
def test_f37_time_zones_only_name_the_day(zone: str, tmp_path: Path) -> None:
    done = scilab_rl(*RANDOM, "n_epochs=1", cwd=tmp_path, variables={"TZ": zone})
    assert done.code == 0
    (run,) = runs_in(tmp_path)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", run.parent.name)


def test_f38_checkpoint_of_other_versions_is_told(tmp_path: Path) -> None:
    killed = scilab_rl(
        *RANDOM, "save_model_freq=50", cwd=tmp_path, fault="metrics.after_row:3:SIGKILL"
    )
    assert killed.code == -9
    for manifest in last_run(tmp_path).glob("checkpoints/step_*/manifest.json"):
        content = json.loads(manifest.read_text())
        content["versions"]["mujoco"] = "1.50"
        manifest.write_text(json.dumps(content))
    resumed = scilab_rl("resume", "last", cwd=tmp_path)
    assert resumed.code == 0, resumed.errors
    assert resumed.errors.count("The checkpoint was written with other versions (mujoco 1.50 ->"), (
        resumed.errors
    )


def test_f39_device_that_is_not_there(tmp_path: Path) -> None:
    for device in ("cuda", "cuda:7", "nonsense"):
        done = scilab_rl("algorithm=cleansac", *RANDOM[1:], f"device={device}", cwd=tmp_path,
                         variables={"CUDA_VISIBLE_DEVICES": ""})  # fmt: skip
        assert done.code == 2, done.errors
        assert "device" in done.error
        assert "device=cpu" in done.error
        assert "Traceback" not in done.errors
    assert not (tmp_path / "data").exists()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with some runs."""
    path = tmp_path_factory.mktemp("terminal")
    for _ in range(2):
        assert scilab_rl(*RANDOM, "n_epochs=1", cwd=path).code == 0
    return path


SHOWING = [["runs"], ["runs", "--json"], ["--help"], ["envs"], ["algorithms"], ["explain", "seed"]]
ENVIRONMENTS = {
    "C locale": {"LC_ALL": "C", "LANG": "C"},
    "ASCII": {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"},
    "dumb": {"TERM": "dumb"},
    "narrow": {"COLUMNS": "20"},
    "no home": {"HOME": "/nonexistent"},
}


def shell(arguments: list[str], cwd: Path, more: str = "", **variables: str):
    line = f"{sys.executable} {ROOT / 'src' / 'main.py'} {' '.join(arguments)} {more}"
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line}"], cwd=cwd, capture_output=True, timeout=120,
        env=quiet_environment(**variables), check=False,
    )  # fmt: skip


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_f40_terminals_and_locales(name: str, folder: Path) -> None:
    for arguments in (["runs"], ["--help"]):
        done = shell(arguments, folder, **ENVIRONMENTS[name])
        assert done.returncode == 0, done.stderr
        assert b"Traceback" not in done.stderr
        assert b"\x1b" not in done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.parametrize("arguments", SHOWING, ids=" ".join)
def test_f40_everything_that_is_shown(arguments: list[str], name: str, folder: Path) -> None:
    done = shell(arguments, folder, **ENVIRONMENTS[name])
    assert done.returncode == 0, done.stderr
    assert b"Traceback" not in done.stderr
    assert b"\x1b" not in done.stdout + done.stderr


@pytest.mark.parametrize("arguments", [["envs"], ["runs"], ["--help"]], ids=" ".join)
def test_f40_reader_that_goes(arguments: list[str], folder: Path) -> None:
    done = shell(arguments, folder, "| head -n 1")
    assert done.returncode in (0, 141), done.stderr
    assert b"Traceback" not in done.stderr
    assert b"Broken pipe" not in done.stderr
    assert len(done.stdout.splitlines()) == 1


def test_f40_closed_streams(folder: Path) -> None:
    for more in ("<&-", ">&-", "2>&-", "< /dev/null", "<&- >&- 2>&-"):
        done = shell(["runs"], folder, more)
        assert done.returncode == 0, (more, done.stderr)
        assert b"Traceback" not in done.stderr


def test_f40_training_without_anybody(tmp_path: Path) -> None:
    done = shell([f"'{word}'" for word in RANDOM], tmp_path, "<&- >&- 2>&-",
                 PYTHONPATH=str(ROOT))  # fmt: skip
    assert done.returncode == 0
    assert result_of(last_run(tmp_path))["status"] == "finished"


def test_f40_full_output(folder: Path) -> None:
    """Standard output on a full disk: one line, no traceback."""
    done = shell(["runs"], folder, "> /dev/full")
    assert done.returncode == 1, done.stderr
    assert b"Traceback" not in done.stderr
    assert b"No space left on device" in done.stderr


@pytest.mark.parametrize("columns", ["20", "100"])
def test_f40_on_a_terminal(columns: str, folder: Path) -> None:
    terminal = os.environ | {"TERM": "xterm", "COLUMNS": columns, "LINES": "24"}
    terminal.pop("CI", None)  # there, even a terminal gets plain lines
    leader, follower = pty.openpty()
    process = subprocess.Popen(
        command("runs"), cwd=folder, stdin=follower, stdout=follower, stderr=follower,
        env=terminal,
    )  # fmt: skip
    os.close(follower)
    shown = b""
    while True:
        try:
            block = os.read(leader, 4096)
        except OSError:  # the other end has been closed
            break
        if not block:
            break
        shown += block
    assert process.wait(60) == 0
    os.close(leader)
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.decode())
    assert "Traceback" not in text
    assert "finished" in text
    if columns == "100":
        assert max(map(len, text.splitlines())) <= 100


OPTIONAL = {
    "mlflow": ("mlflow=1", 0, "switched off"),
    "wandb": ("wandb=1", 2, "scilab-rl[wandb]"),
    "tensorboard": ("tensorboard=1", 2, "scilab-rl[tensorboard]"),
    "jax": ("algorithm=jaxsac", 2, "scilab-rl[jax]"),
    "rerun": ("render=display", 2, "scilab-rl[view]"),
    "highway_env": ("env=highway-v0", 2, "scilab-rl[highway]"),
    "metaworld": ("env=Meta-World/reach-v3", 2, "scilab-rl[metaworld]"),
}


@pytest.mark.parametrize("package", OPTIONAL)
def test_f41_missing_package_is_one_line_with_what_to_type(package: str, tmp_path: Path) -> None:
    key, code, words = OPTIONAL[package]
    name = key.partition("=")[0]
    rest = [word for word in RANDOM if word.partition("=")[0] != name]
    done = scilab_rl(*rest, key, cwd=tmp_path, hidden=(package,))
    assert done.code == code, done.errors
    assert words in done.errors
    assert "Traceback" not in done.errors


HEAVY = ("mlflow", "wandb", "tensorboard", "jax", "optax", "rerun", "ray", "submitit", "metaworld",
         "highway_env", "panda_gym", "scipy", "cmaes", "psycopg", "matplotlib")  # fmt: skip


def test_f41_training_with_the_core_alone(tmp_path: Path) -> None:
    rest = [word for word in RANDOM if word != "mlflow=0"]
    done = scilab_rl(*rest, cwd=tmp_path, hidden=HEAVY)
    assert done.code == 0, done.errors
    assert result_of(last_run(tmp_path))["status"] == "finished"


def test_f41_help_is_there_at_once(tmp_path: Path) -> None:
    """In its own processor time, which does not depend on what else the machine does."""
    import resource

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        command("--help"), cwd=tmp_path, env=quiet_environment(), capture_output=True, check=False
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert seconds < 1.5


def test_f36_run_directories_are_made_by_mkdir_alone(tmp_path: Path) -> None:
    first = RunDirectory.create(tmp_path, "E", "a", 1)
    assert first.path.is_dir()
    with pytest.raises(FileExistsError):
        first.path.mkdir()


@pytest.mark.parametrize(
    ("answer", "report"),
    [
        ("raise SystemExit('no network')", r"Nothing was audited: .*\n"),
        ("print(answer(skip_reason='not found'))", r"Nothing was audited: .*\n"),
        ("print(answer(vulns=[]))", r"1 of \d\d\d pinned packages .*\n"),
        ("print(answer(vulns=[{'id': 'CVE-1'}]))", r"1 of \d\d\d .*\nx 1 has CVE-1\n"),
    ],
)
def test_audit_reports_and_never_decides(answer: str, report: str, tmp_path: Path) -> None:
    (tmp_path / "pip_audit.py").write_text(
        "import json\ndef answer(**more):\n"
        "    return json.dumps({'dependencies': [{'name': 'x', 'version': '1', **more}]})\n"
        + answer
    )
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "audit.py")],
        env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert re.fullmatch(report, done.stdout)


GOLDEN = Path(__file__).parent / "golden"


@pytest.mark.parametrize("release", sorted(path.name for path in GOLDEN.iterdir()))
def test_f38_runs_of_every_release_can_be_played_and_resumed(release: str, tmp_path: Path) -> None:
    """Each release leaves a small run here; a new format must go on reading it."""
    run = tmp_path / "data" / "2026-01-01" / f"run-of-{release}"
    shutil.copytree(GOLDEN / release, run)
    played = scilab_rl("play", str(run / "rl_model_finished"), "--episodes", "1", cwd=tmp_path)
    assert played.code == 0, played.errors
    resumed = scilab_rl("resume", str(run), cwd=tmp_path)
    assert resumed.code == 0, resumed.errors
    result = result_of(run)
    assert (result["status"], result["steps"]) == ("finished", 64)
