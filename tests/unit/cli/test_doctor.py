import shutil
import subprocess
import sys
from collections import namedtuple
from importlib import metadata
from textwrap import dedent

import pytest

from scilab_rl.cli import doctor
from scilab_rl.envs import fingerprint
from scilab_rl.recording import gl

from .conftest import read_json, read_table, write_file


def results(check) -> dict[str, doctor.CheckResult]:
    return {finding.check: finding for finding in check()}


def test_this_installation_is_sound(project, capsys):
    assert doctor.main([]) == 0
    rows = {row["check"]: row for row in read_table(capsys.readouterr().out)}
    for check in (
        "python",
        *doctor.CORE,
        "FetchReach-v4 fingerprint",
        "ffmpeg",
        "disk",
        "device",
        "project",
    ):
        assert rows[check]["result"] == "ok", rows[check]
    assert {f"rendering with {backend}" for backend in gl.BACKENDS} <= {*rows}
    assert {f"extra {extra}" for extra in doctor.EXTRAS} <= {*rows}


def test_a_failure_makes_the_exit_code_1(project, monkeypatch, capsys):
    monkeypatch.setattr(
        doctor, "check_python", lambda: [doctor.CheckResult("python", "fail", "2.7", "x")]
    )
    for name in (
        "check_rendering",
        "check_ffmpeg",
        "check_project",
        "check_device",
        "check_extras",
    ):
        monkeypatch.setattr(doctor, name, lambda: [])
    assert doctor.main(["--json"]) == 1
    failed = [row for row in read_json(capsys.readouterr().out) if row["result"] == "fail"]
    assert failed == [{"check": "python", "result": "fail", "found": "2.7", "fix": "x"}]


def test_a_check_that_breaks_is_a_finding(monkeypatch):
    def check_versions():
        raise metadata.PackageNotFoundError("scilab-rl")

    monkeypatch.setattr(doctor, "check_versions", check_versions)
    found = {finding.check: finding for finding in doctor.check_installation()}
    assert found["versions"].result == "fail"
    assert "disk" in found


@pytest.mark.parametrize(
    ("version", "result"), [("3.3.0", "ok"), ("3.6.9", "ok"), ("3.7.0", "warn"), ("4.0.0", "warn")]
)
def test_versions_are_compared_with_the_declared_ones(monkeypatch, version, result):
    real = metadata.version
    monkeypatch.setattr(metadata, "version", lambda n: version if n == "mujoco" else real(n))
    finding = results(doctor.check_versions)["mujoco"]
    assert finding.result == result
    if result == "warn":
        assert finding.fix == 'pip install "mujoco<3.7,>=3.3"'


def test_a_missing_package_fails(monkeypatch):
    real = metadata.version

    def version(name):
        if name == "torch":
            raise metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(metadata, "version", version)
    found = results(doctor.check_versions)
    assert (found["torch"].result, found["numpy"].result) == ("fail", "ok")


@pytest.mark.parametrize(
    ("value", "mujoco", "result"),
    [
        ("54a0c22ef6c6dec6", "3.4.0", "ok"),
        ("cf25fd21b72a860f", "3.7.0", "fail"),
        ("0000000000000000", doctor.REFERENCE_MUJOCO, "warn"),
    ],
)
def test_the_fingerprint_tells_a_changed_robot(monkeypatch, value, mujoco, result):
    monkeypatch.setattr(fingerprint, "fingerprint", lambda env: value)
    monkeypatch.setattr(metadata, "version", lambda name: mujoco)
    (finding,) = doctor.check_fingerprint()
    assert finding.result == result
    assert value in finding.found


def test_one_back_end_is_enough(monkeypatch):
    monkeypatch.setattr(gl, "probe", lambda backend: None if backend == "osmesa" else "no driver")
    found = results(doctor.check_rendering)
    assert [found[f"rendering with {b}"].result for b in gl.BACKENDS] == ["info", "ok", "info"]


def test_without_any_back_end_the_fix_is_the_line_to_type(monkeypatch):
    monkeypatch.setattr(gl, "probe", lambda backend: "no driver")
    for finding in doctor.check_rendering():
        assert (finding.result, finding.fix) == ("warn", f"sudo {gl.APT_LINE}")


def test_a_wrong_ffmpeg_is_found(monkeypatch, tmp_path):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "no_such_ffmpeg"))
    (finding,) = doctor.check_ffmpeg()
    assert finding.result == "warn"
    assert "IMAGEIO_FFMPEG_EXE" in finding.fix


def test_a_broken_desk_fails(project):
    write_file(project / "src/custom_envs/__init__.py", "import nowhere\n")
    (finding,) = doctor.check_project()
    assert finding.result == "fail"
    assert "nowhere" in finding.found


def test_a_broken_algorithm_is_a_warning(project):
    write_file(project / "conf/algorithm/bad.yaml", "name: bad\n_target_: nowhere.BAD\n")
    found = results(doctor.check_project)
    assert found["algorithm=bad"].result == "warn"
    assert found["project"].result == "ok"


@pytest.mark.parametrize(("free", "result"), [(2**20, "fail"), (2**31, "warn"), (2**40, "ok")])
def test_little_space_is_found(project, monkeypatch, free, result):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage(2**41, 0, free))
    (finding,) = doctor.check_disk()
    assert finding.result == result


def test_a_missing_extra_names_its_line(monkeypatch):
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    finding = results(doctor.check_extras)["extra wandb"]
    assert (finding.result, finding.fix) == ("info", 'pip install "scilab-rl[wandb]"')


def test_the_rendering_hint_stops_at_the_first_back_end_that_works(monkeypatch, capsys):
    tried = []
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "")  # so that it is restored
    monkeypatch.setattr(gl, "probe", lambda backend: tried.append(backend))
    assert doctor.main(["--rendering-hint"]) == 0
    assert tried == ["egl"]
    assert capsys.readouterr().out == ""


def test_the_rendering_hint_names_the_packages(monkeypatch, capsys):
    monkeypatch.setattr(gl, "probe", lambda backend: "no driver")
    assert doctor.main(["--rendering-hint"]) == 0
    assert "Training works without pictures." in capsys.readouterr().out


def test_the_rendering_hint_runs_as_a_module(tmp_path):
    command = [sys.executable, "-m", "scilab_rl.cli.doctor", "--rendering-hint"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == "" or gl.APT_LINE in done.stdout


def test_an_environment_is_checked_with_its_arguments(project, capsys):
    words = ["env=PointGym-v0", "env_kwargs.threshold=0.25", "--steps", "60"]
    assert doctor.main(words) == 0
    rows = {row["check"]: row for row in read_table(capsys.readouterr().out)}
    assert rows["rewards of a batch"]["found"] == "equal on 60 steps"
    assert rows["seeds"]["result"] == "ok"


def test_a_broken_environment_makes_the_exit_code_1(project, capsys):
    write_file(
        project / "src/custom_envs/__init__.py",
        dedent("""
        import gymnasium
        from gymnasium.envs.classic_control import PendulumEnv

        class Stuck(PendulumEnv):
            def step(self, action):
                raise RuntimeError("motor off")

        gymnasium.register("Stuck-v0", entry_point=Stuck, max_episode_steps=9)
        """),
    )
    assert doctor.main(["env=Stuck-v0"]) == 1
    assert "RuntimeError: motor off" in capsys.readouterr().out
