"""The real Weights & Biases, offline."""

import shutil
import subprocess
import types

import pytest

from scilab_rl.tracking.wandb import has_key

pytest.importorskip("wandb")

ONE_RUN = """
    import logging, sys, warnings
    from pathlib import Path
    warnings.simplefilter("ignore")
    logging.basicConfig(stream=sys.stdout, format="%(levelname)s %(message)s", level=logging.INFO)
    from scilab_rl.results import RunResult
    from scilab_rl.config.schema import AlgorithmConfig, RunConfig
    from scilab_rl.tracking.base import TrackedRun
    from scilab_rl.tracking.wandb import WandbTracker
    base = Path(sys.argv[1])
    folder = base / "2026-01-02" / "run"
    (folder / "videos").mkdir(parents=True)
    film = folder / "videos" / "film.mp4"
    film.write_bytes(b"frames")
    tracker = WandbTracker()
    sac = AlgorithmConfig("sac", arguments={"gamma": 0.9})
    cfg = RunConfig("TinyReach-v0", base_logdir=str(base), seed=7, n_epochs=2, algorithm=sac)
    tracker.begin(TrackedRun(cfg, folder))
    tracker.epoch(10, 1, {"eval/mean_reward": -1.0})
    tracker.artifact(film)
    print("this belongs to the terminal")
    tracker.end(RunResult("finished", 0.5, 2, 20, 3.0, str(folder)))
"""


def without_network():
    """Return the command that hides the network from a process, where that is allowed."""
    command = ["unshare", "-rn"]
    allowed = shutil.which("unshare") and subprocess.run(
        [*command, "true"], check=False, capture_output=True
    )
    return command if allowed and allowed.returncode == 0 else None


def run_offline(tmp_path, in_a_process, **options):
    base = tmp_path / "data"
    base.mkdir()
    process = in_a_process(ONE_RUN, base, **options)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert list(in_a_process.home.iterdir()) == list(in_a_process.folder.iterdir()) == []
    return base, output, errors


def test_without_a_key_it_is_offline_says_how_to_sync_and_never_asks(tmp_path, in_a_process):
    base, output, errors = run_offline(tmp_path, in_a_process)
    (folder,) = (base / "2026-01-02" / "run" / "wandb").glob("offline-run-*")
    assert output.splitlines() == [
        "this belongs to the terminal",
        f"INFO W&B is offline; sync with: wandb sync {folder}",
    ]
    assert errors == ""
    assert {path.name for path in base.iterdir()} == {"2026-01-02", ".wandb"}
    assert (folder / "files/media/videos/video").is_dir()
    (record,) = folder.glob("*.wandb")
    for expected in (b"algorithm.gamma", b"eval/mean_reward", b"video/film"):
        assert expected in record.read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(without_network() is None, reason="needs unshare -rn")
def test_a_key_without_network_falls_back_to_offline_with_one_warning(tmp_path, in_a_process):
    key = {"WANDB_API_KEY": "0" * 40}
    _, output, _ = run_offline(tmp_path, in_a_process, prefix=without_network(), **key)
    warnings = [line for line in output.splitlines() if line.startswith("WARNING")]
    assert len(warnings) == 1
    assert warnings[0].startswith("WARNING W&B cannot be reached (")
    assert "INFO W&B is offline; sync with: wandb sync" in output


def test_a_key_is_found_in_the_environment_or_in_netrc(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    assert not has_key()
    (tmp_path / ".netrc").write_text("machine api.wandb.ai login user password secret\n")
    (tmp_path / ".netrc").chmod(0o600)
    assert has_key()
    (tmp_path / ".netrc").write_text("what is this\n")
    assert not has_key()
    monkeypatch.setenv("WANDB_API_KEY", "secret")
    assert has_key()


def test_columns_of_its_own_are_not_overwritten():
    from scilab_rl.tracking.wandb import WandbTracker

    logged = {}
    tracker = WandbTracker()
    tracker._run = types.SimpleNamespace(log=lambda values, step: logged.update(values))
    names = ("_step", "_timestamp", "_runtime", "_x5f_step", "train/α", "train/β", "a b", "_steps")
    tracker.epoch(10, 1, dict.fromkeys(names, 1.0))
    assert len(logged) == len(names)
    assert not {"_step", "_timestamp", "_runtime"} & {*logged}
    assert {"train/α", "train/β", "a b", "_steps"} <= {*logged}
