"""Disks that are full, read-only or gone, and files that are damaged."""

from __future__ import annotations

import json
import os
import random
import shutil
from pathlib import Path

import pytest

from scilab_rl.training import checkpoint

from .harness import (
    CLEANSAC,
    RANDOM,
    Process,
    allows_namespaces,
    content,
    last_run,
    result_of,
    runs_in,
    scilab_rl,
    wait_until,
)

NAMESPACES = pytest.mark.skipif(
    not allows_namespaces(), reason="this machine forbids disks and networks of one's own"
)
WITH_CHECKPOINTS = (*CLEANSAC, "eval_after_n_steps=40", "n_test_rollouts=1", "save_model_freq=30")


def check_nothing_is_half(run: Path) -> None:
    """Check that every file that says it is whole is whole."""
    json.loads((run / "result.json").read_text())
    for manifest in run.rglob("manifest.json"):
        checkpoint.verify(manifest.parent)
    lines = (run / "metrics.jsonl").read_text().splitlines()
    for line in lines[:-1]:
        json.loads(line)


def test_f05_full_disk_costs_a_checkpoint_and_not_the_run(tmp_path: Path) -> None:
    full = scilab_rl(*WITH_CHECKPOINTS, cwd=tmp_path, fault="checkpoint.in_arrays:30:ENOSPC")
    assert full.code == 0, full.errors
    warnings = [line for line in full.errors.splitlines() if "No space left" in line]
    assert len(warnings) == 1
    assert warnings[0].endswith("Training continues.")
    run = last_run(tmp_path)
    check_nothing_is_half(run)
    assert not list(run.rglob(".*.tmp"))
    assert result_of(run)["status"] == "finished"


def test_f05_full_disk_for_metrics_ends_the_run_with_path_and_space(tmp_path: Path) -> None:
    full = scilab_rl(*RANDOM, cwd=tmp_path, fault="metrics.before_line:10:ENOSPC")
    assert full.code == 1
    run = last_run(tmp_path)
    path = (run / "metrics.jsonl").relative_to(tmp_path)
    assert f"'{path}' cannot be written: No space left on device (" in full.error
    assert "MiB free)" in full.error
    assert result_of(run)["status"] == "failed"
    check_nothing_is_half(run)


@NAMESPACES
def test_f05_real_disk_that_is_full(tmp_path: Path) -> None:
    """Whatever the size, there is no traceback, and a failed run says that it failed."""
    codes = set()
    for size in ("4k", "24k", "96k"):
        done = scilab_rl(*RANDOM, cwd=tmp_path, disk=size)
        codes.add(done.code)
        assert done.code in (0, 1, 2), done.errors
        assert "Traceback" not in done.errors
        assert "Logging error" not in done.errors
        if done.code:
            assert "No space left on device" in done.error
    assert codes == {0, 1, 2}


def test_f05_limit_for_files(tmp_path: Path) -> None:
    """As `ulimit -f` sets it: writing fails in the middle of a file."""
    for limit in (0, 100, 3000, 8000):
        done = scilab_rl(*RANDOM, cwd=tmp_path, file_limit=limit)
        # What the run itself wrote, not what this test collects from it, is of interest here.
        assert done.code in (0, 1, 2), done.errors
        assert "Traceback" not in done.errors
        for run in runs_in(tmp_path):
            for manifest in run.rglob("manifest.json"):
                checkpoint.verify(manifest.parent)


@NAMESPACES
def test_f06_read_only_disk(tmp_path: Path) -> None:
    done = scilab_rl(*RANDOM, cwd=tmp_path, disk="read-only")
    assert done.code == 2
    assert "cannot be created in 'data': Read-only file system" in done.error
    assert "base_logdir=DIR" in done.error


@pytest.mark.parametrize(
    ("base", "reason"),
    [
        ("x" * 300, "File name too long"),
        ("a-file", "Not a directory|File exists"),
        ("a-file/below", "Not a directory"),
        ("/proc/nothing", "No such file or directory"),
    ],
)
def test_f06_folder_that_cannot_be(base: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "a-file").write_text("")
    done = scilab_rl(*RANDOM, f"base_logdir={base}", cwd=tmp_path)
    assert done.code == 2
    assert any(word in done.error for word in reason.split("|")), done.error
    assert "base_logdir=DIR" in done.error


def test_f06_folder_that_vanishes_meanwhile(tmp_path: Path) -> None:
    process = Process((*RANDOM, "n_epochs=100000"), tmp_path)
    wait_until(lambda: list(tmp_path.glob("data/*/*/metrics.csv")))
    # In one stroke: a folder that is emptied file by file gets new ones meanwhile.
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    shutil.rmtree(tmp_path / "elsewhere", ignore_errors=True)
    done = process.wait(60)
    assert done.code == 1
    assert "cannot be written: No such file or directory" in done.error
    assert "Traceback" not in done.errors


@pytest.fixture(scope="module")
def stopped_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with two generations of checkpoints that has not ended."""
    folder = tmp_path_factory.mktemp("stopped")
    done = scilab_rl(*RANDOM, "save_model_freq=50", cwd=folder, fault="metrics.after_row:3:SIGKILL")
    assert done.code == -9, done.errors
    assert len(list(last_run(folder).glob("checkpoints/step_*"))) == 2
    return folder


def damages(directory: Path, rng: random.Random):
    """Yield ways to damage a checkpoint, each with a name."""
    files = sorted(path for path in directory.rglob("*") if path.is_file())
    for path in files:
        whole = path.read_bytes()
        for name, end in (("empty", 0), ("half", len(whole) // 2), ("cut", len(whole) - 2)):
            yield f"{name} {path.name}", lambda p=path, w=whole, e=end: p.write_bytes(w[:e])
        yield f"no {path.name}", path.unlink
    tensors = directory / "tensors.safetensors"
    whole = tensors.read_bytes()
    for _ in range(20):
        changed = bytearray(whole)
        changed[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        yield "flipped bit", lambda c=bytes(changed): tensors.write_bytes(c)
    manifest = json.loads((directory / "manifest.json").read_text())
    other = json.dumps(manifest | {"schema_version": 99})
    yield "other schema", lambda: (directory / "manifest.json").write_text(other)


def test_f07_damaged_checkpoint_is_told_and_the_older_one_is_used(
    stopped_run: Path, caplog: pytest.LogCaptureFixture
) -> None:
    from scilab_rl.training import resume

    run = last_run(stopped_run)
    older, newest = sorted(run.glob("checkpoints/step_*"))
    copy = stopped_run / "copy"
    shutil.copytree(newest, copy)
    n = 0
    for name, damage in damages(newest, random.Random(0)):
        damage()
        caplog.clear()
        _, step = resume.load_latest(run)
        assert step == int(older.name.removeprefix("step_")), name
        assert f"Using the older {older.name}" in caplog.text, name
        shutil.rmtree(newest)
        shutil.copytree(copy, newest)
        n += 1
    assert n >= 40
    _, step = resume.load_latest(run)
    assert step == int(newest.name.removeprefix("step_"))


def test_f07_resumed_from_the_older_one_it_ends_the_same(stopped_run: Path, tmp_path: Path) -> None:
    shutil.copytree(stopped_run / "data", tmp_path / "data", symlinks=True)
    (run,) = runs_in(tmp_path)
    newest = sorted(run.glob("checkpoints/step_*"))[-1]
    (newest / "state.json").write_text("{}")
    resumed = scilab_rl("resume", str(run), cwd=tmp_path)
    assert resumed.code == 0, resumed.errors
    assert "is damaged: state.json has changed" in resumed.errors
    whole = tmp_path / "whole"
    whole.mkdir()
    assert scilab_rl(*RANDOM, "save_model_freq=50", cwd=whole).code == 0
    assert content(run) == content(last_run(whole))


def test_f07_all_damaged_ends_with_exit_code_1_and_nothing_changes(
    stopped_run: Path, tmp_path: Path
) -> None:
    shutil.copytree(stopped_run / "data", tmp_path / "data", symlinks=True)
    (run,) = runs_in(tmp_path)
    for directory in run.glob("checkpoints/step_*"):
        os.truncate(directory / "tensors.safetensors", 10)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    done = scilab_rl("resume", str(run), cwd=tmp_path)
    assert done.code == 1
    assert done.error.count("tensors.safetensors has changed since it was saved") == 2
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_f08_configuration_of_a_run_is_never_half_written(tmp_path: Path) -> None:
    killed = scilab_rl(*RANDOM, cwd=tmp_path, fault="file.before_replace:3:SIGKILL")
    assert killed.code == -9
    for path in tmp_path.rglob("config.yaml"):
        assert "n_threads" in path.read_text()
    for path in tmp_path.rglob("result.json"):
        json.loads(path.read_text())


def test_f42_clean_lists_and_removes_only_when_told(tmp_path: Path) -> None:
    killed = scilab_rl(*RANDOM, cwd=tmp_path, fault="file.before_replace:3:SIGKILL")
    assert killed.code == -9
    kept = scilab_rl(*RANDOM, "save_model_freq=50", cwd=tmp_path,
                     fault="checkpoint.in_arrays:9:SIGKILL")  # fmt: skip
    assert kept.code == -9
    finished = scilab_rl(*RANDOM, cwd=tmp_path)
    assert finished.code == 0
    (tmp_path / "data" / "mine.db").write_text("precious")

    def everything() -> set[Path]:
        return set((tmp_path / "data").rglob("*"))

    before = everything()
    for flags in ((), ("--dry-run",)):
        listed = scilab_rl("clean", *flags, cwd=tmp_path)
        assert listed.code == 0
        assert "unfinished file" in listed.output
        assert "run without any result" in listed.output
        assert "Nothing has been removed" in listed.errors
        assert everything() == before
    assert scilab_rl("clean", "--dry-run", "--yes", cwd=tmp_path).code == 2
    assert scilab_rl("clean", "--yes", cwd=tmp_path).code == 0
    gone = before - everything()
    assert gone
    assert not list(tmp_path.rglob("*.tmp"))
    assert len(runs_in(tmp_path)) == 2
    assert (tmp_path / "data" / "mine.db").read_text() == "precious"
    assert "Nothing to clean" in scilab_rl("clean", cwd=tmp_path).errors


def test_f42_clean_leaves_running_runs_alone(tmp_path: Path) -> None:
    process = Process((*RANDOM, "env_kwargs.fault=hang", "env_kwargs.at=40"), tmp_path)
    wait_until(lambda: runs_in(tmp_path))
    done = scilab_rl("clean", "--yes", cwd=tmp_path)
    assert "Nothing to clean" in done.errors
    process.signal(9)
    process.wait()
    assert "run without any result" in scilab_rl("clean", cwd=tmp_path).output
