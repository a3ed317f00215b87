import json
import os
import random
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import zipfile
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch

from scilab_rl import files
from scilab_rl.errors import CheckpointError, ConfigError
from scilab_rl.training import checkpoint, sb3_archives
from scilab_rl.training.snapshot import Snapshot, capture, restore


def snapshot_of(number):
    weights = torch.arange(12, dtype=torch.float32).reshape(3, 4).T + number
    return capture({"weights": weights, "buffer": np.full((5, 2), number), "step": number})


@pytest.fixture
def saved(tmp_path):
    directory = tmp_path / "policy"
    checkpoint.save(snapshot_of(1), directory, step=10, about={"epoch": 3})
    return directory


def contents(directory):
    return sorted(path for path in directory.rglob("*") if path.is_file())


def test_what_is_loaded_is_what_was_saved(saved):
    restored = restore(dict.fromkeys(("weights", "buffer", "step")), checkpoint.load(saved))
    assert restored["weights"][1, 0] == 2.0
    assert restored["buffer"].tolist() == [[1, 1]] * 5
    assert restored["step"] == 1


def test_the_manifest_says_what_when_and_with_which_versions(saved):
    manifest = checkpoint.verify(saved)
    assert (manifest["schema_version"], manifest["step"], manifest["epoch"]) == (1, 10, 3)
    assert manifest["versions"]["torch"] == metadata.version("torch")
    assert set(manifest["files"]) == {"tensors.safetensors", "state.json", "arrays/0.npy"}


def test_saving_again_replaces_and_leaves_nothing_else(saved):
    checkpoint.save(snapshot_of(2), saved, step=20)
    assert checkpoint.load(saved).tree["step"] == 2
    assert [path.name for path in saved.parent.iterdir()] == ["policy"]


def test_a_failed_save_leaves_the_old_one(saved):
    with pytest.raises(TypeError):
        checkpoint.save(Snapshot(tree={"x": object()}), saved, step=20)
    assert checkpoint.load(saved).tree["step"] == 1
    assert [path.name for path in saved.parent.iterdir()] == ["policy"]


def test_the_leftovers_of_a_killed_process_are_removed(saved):
    (saved.parent / ".policy.4711.tmp" / "arrays").mkdir(parents=True)
    checkpoint.save(snapshot_of(2), saved, step=20)
    assert [path.name for path in saved.parent.iterdir()] == ["policy"]


def test_a_process_killed_between_the_two_renames_loses_nothing(saved):
    saved.rename(saved.with_name("policy.old"))
    assert checkpoint.load(saved).tree["step"] == 1


@pytest.mark.parametrize("cut", ["empty", "half", "last byte"])
@pytest.mark.parametrize(
    "name", ["manifest.json", "state.json", "tensors.safetensors", "arrays/0.npy"]
)
def test_a_cut_file_is_noticed(saved, name, cut):
    path = saved / name
    whole = path.read_bytes()
    # the manifest's own last byte is a newline that carries nothing
    end = {"empty": 0, "half": len(whole) // 2, "last byte": len(whole) - 2}[cut]
    path.write_bytes(whole[:end])
    with pytest.raises(CheckpointError, match="policy"):
        checkpoint.load(saved)


@pytest.mark.parametrize(
    "name", ["manifest.json", "state.json", "tensors.safetensors", "arrays/0.npy"]
)
def test_a_missing_file_is_noticed(saved, name):
    (saved / name).unlink()
    with pytest.raises(CheckpointError):
        checkpoint.load(saved)


def test_any_flipped_bit_is_noticed(saved):
    rng = random.Random(0)
    paths = [path for path in contents(saved) if path.name != "manifest.json"]
    for _ in range(200):
        path = rng.choice(paths)
        whole = path.read_bytes()
        changed = bytearray(whole)
        changed[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        with pytest.raises(CheckpointError, match="damaged"):
            checkpoint.load(saved)
        path.write_bytes(whole)
    checkpoint.load(saved)


def test_a_flipped_bit_in_the_manifest_never_loads_other_values(saved):
    """The manifest may lose a version or a comment unnoticed, but not what it protects."""
    rng, path = random.Random(0), saved / "manifest.json"
    whole, expected = path.read_bytes(), checkpoint.load(saved).tensors["weights"].clone()
    for _ in range(200):
        changed = bytearray(whole)
        changed[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        try:
            loaded = checkpoint.load(saved)
        except CheckpointError:
            continue
        assert torch.equal(loaded.tensors["weights"], expected)


def test_files_of_another_checkpoint_are_noticed(saved, tmp_path):
    checkpoint.save(snapshot_of(2), tmp_path / "other", step=10)
    for name in ("state.json", "tensors.safetensors", "arrays/0.npy"):
        mine = (saved / name).read_bytes()
        shutil.copy(tmp_path / "other" / name, saved / name)
        with pytest.raises(CheckpointError, match=f"{name} has changed"):
            checkpoint.load(saved)
        (saved / name).write_bytes(mine)


def rewrite_manifest(saved, change):
    path = saved / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def test_another_schema_is_refused(saved):
    rewrite_manifest(saved, lambda manifest: manifest.update(schema_version=99))
    with pytest.raises(CheckpointError, match="has format 99; this version of Scilab-RL reads 1"):
        checkpoint.load(saved)


@pytest.mark.parametrize(
    "broken", [[], {}, None, {"files": []}, {"files": {"state.json": 1}}, "x" * 9]
)
def test_a_manifest_that_is_something_else_is_refused(saved, broken):
    (saved / "manifest.json").write_text(json.dumps(broken))
    with pytest.raises(CheckpointError, match="not a complete checkpoint"):
        checkpoint.load(saved)


def test_a_manifest_without_end_is_refused(saved):
    (saved / "manifest.json").write_text("[" * 100_000)
    with pytest.raises(CheckpointError, match="not a complete checkpoint"):
        checkpoint.load(saved)


@pytest.mark.parametrize("name", ["../secret.npy", "arrays/../../secret.npy", "/etc/hostname"])
def test_files_outside_the_checkpoint_are_never_read(saved, name):
    secret = saved.parent / "secret.npy"
    np.save(secret, np.ones(3))
    fact = {"bytes": secret.stat().st_size, "sha256": files.sha256(secret)}
    rewrite_manifest(saved, lambda manifest: manifest["files"].update({name: fact}))
    with pytest.raises(CheckpointError):
        checkpoint.load(saved)


@pytest.mark.parametrize("name", ["../../secret.npy", "../state.json", "1.npy"])
def test_arrays_that_the_manifest_does_not_list_are_never_read(saved, name):
    np.save(saved.parent / "secret.npy", np.ones(3))
    state = json.loads((saved / "state.json").read_text())
    state["arrays"]["buffer"] = name
    (saved / "state.json").write_text(json.dumps(state))
    sign(saved)
    with pytest.raises(CheckpointError, match="manifest does not list"):
        checkpoint.load(saved)


def test_a_link_out_of_the_checkpoint_is_refused(saved):
    outside = saved.parent / "outside.npy"
    shutil.move(saved / "arrays/0.npy", outside)
    (saved / "arrays/0.npy").symlink_to(outside)
    with pytest.raises(CheckpointError):
        checkpoint.load(saved)


class Evil:
    def __reduce__(self):
        return (Path.touch, (Path("canary"),))


def test_pickles_are_never_executed(saved, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save(saved / "arrays/0.npy", np.array([Evil()], dtype=object), allow_pickle=True)
    sign(saved)
    with pytest.raises(CheckpointError, match="Python objects"):
        checkpoint.load(saved)
    torch.save(Evil(), saved / "tensors.safetensors")
    sign(saved)
    with pytest.raises(CheckpointError):
        checkpoint.load(saved)
    assert not Path("canary").exists()


def sign(saved):
    """Do what an attacker does: make the manifest fit."""
    facts = {
        str(path.relative_to(saved)): {"bytes": path.stat().st_size, "sha256": files.sha256(path)}
        for path in contents(saved)
        if path.name != "manifest.json"
    }
    rewrite_manifest(saved, lambda manifest: manifest.update(files=facts))


def test_a_foreign_zip_is_refused_with_the_way_to_allow_it(tmp_path):
    path = tmp_path / "model.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(ConfigError, match="--trust-pickle"):
        sb3_archives.load_archive(None, path)
    with pytest.raises(ConfigError, match="no saved policy"):
        checkpoint.load(path)


def test_nothing_there_is_said(tmp_path):
    with pytest.raises(ConfigError, match="no saved policy"):
        checkpoint.load(tmp_path / "nowhere")


WRITER = """
    import sys
    from pathlib import Path
    import numpy as np, torch
    from scilab_rl.training import checkpoint, sb3_archives
    from scilab_rl.training.snapshot import capture
    for number in range(10_000):
        state = {"weights": torch.full((50_000,), float(number)), "step": number}
        checkpoint.save(capture(state), Path(sys.argv[1]), step=number)
        print(number, flush=True)
"""


def test_a_kill_at_any_moment_leaves_a_whole_checkpoint(tmp_path):
    directory, rng = tmp_path / "policy", random.Random(1)
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    for _ in range(3):
        with subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(WRITER), str(directory)],
            stdout=subprocess.PIPE,
            env=environment,
        ) as writer:
            writer.stdout.readline()  # importing is over
            time.sleep(rng.uniform(0.0, 0.3))
            writer.send_signal(signal.SIGKILL)
            written = writer.stdout.read().split()
        loaded = checkpoint.load(directory)
        step = loaded.tree["step"]
        assert step >= int(written[-1] if written else 0)
        assert torch.equal(loaded.tensors["weights"], torch.full((50_000,), float(step)))
