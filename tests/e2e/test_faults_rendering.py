"""What goes wrong while episodes are shown or recorded, and that training goes on."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from scilab_rl.recording.records import load_clip

from .commands import QUICK, command, last_run, quiet_environment, scilab_rl

pytestmark = pytest.mark.slow

PIXELS = "env=scilab_rl.testing:TinyPixels-v0"
RECORD = ("algorithm=random", "render=record", "render_freq=1", "mlflow=0", "n_test_rollouts=1")
# A run whose folder of recordings is a disk of its own, of the size given first.
WITH_SMALL_DISK = """
import shutil, subprocess, sys
from pathlib import Path
from scilab_rl.config.compose import compose
from scilab_rl.config.workspace import open_project
from scilab_rl.run.run import start_run
from scilab_rl.training.callbacks import RunCallback

kept = Path("kept")

class SmallDisk(RunCallback):
    def begin(self, trainer):
        self.folder = trainer.run_dir / "episodes"
        self.folder.mkdir()
        disk = ["-t", "tmpfs", "-o", f"size={sys.argv[1]}", "tmpfs", str(self.folder)]
        subprocess.run(["mount", *disk], check=True)

    def close(self):
        shutil.copytree(self.folder, kept)

open_project()
result = start_run(compose(sys.argv[2:]), callbacks=[SmallDisk()])
print(result.status, result.steps)
"""

# A live view whose only viewer stops reading, so that all buffers fill up.
WITH_STUCK_VIEWER = """
import os, signal, subprocess, time
import numpy as np
from scilab_rl.recording.live import LiveViewer, free_port, start_viewer
from scilab_rl.recording.records import ClipInfo, Record, encode_picture

viewer = LiveViewer((), window=False)
options = ["--serve-grpc", "--bind", "127.0.0.1", "--port", str(free_port(viewer.data_port + 1))]
reader = start_viewer([viewer.uri, *options], subprocess.DEVNULL)
time.sleep(3)
os.kill(reader.pid, signal.SIGSTOP)
noise = np.random.default_rng(0).integers(0, 256, (1024, 1024, 3), dtype=np.uint8)
scene = Record("train", 0, 0, 1, 0, encode_picture(noise), None)
viewer.begin(ClipInfo("noise", "train", 1, "noise", "noise", 25.0, ()))
longest, began = 0.0, time.monotonic()
while viewer.n_dropped_pictures < 500 and time.monotonic() - began < 60:
    started = time.thread_time()
    viewer.add(scene)
    longest = max(longest, time.thread_time() - started)
    time.sleep(0.002)
print(viewer.n_dropped_pictures, longest, flush=True)
viewer.close()
reader.kill()
reader.wait()
print(time.time(), flush=True)
"""


def allowed_to_mount() -> bool:
    if not shutil.which("unshare"):
        return False
    return subprocess.run(["unshare", "-rm", "true"], check=False).returncode == 0


@pytest.mark.skipif(not allowed_to_mount(), reason="needs unshare -rm")
@pytest.mark.parametrize("size", ["4k", "32k"])
def test_f05_full_disk_ends_recording_not_training(tmp_path: Path, size: str) -> None:
    options = [PIXELS, *RECORD, "seed=1", "n_epochs=3", "eval_after_n_steps=40"]
    done = subprocess.run(
        ["unshare", "-rm", sys.executable, "-c", WITH_SMALL_DISK, size, *options],
        cwd=tmp_path,
        env=quiet_environment(),
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.stdout.splitlines()[-1:] == ["finished 120"], done.stderr
    log = (last_run(tmp_path) / "train.log").read_text(encoding="utf-8")
    warnings = [line for line in log.splitlines() if "WARNING" in line]
    assert len(warnings) == 1, log
    assert "Training continues" in warnings[0]
    for path in (tmp_path / "kept").iterdir():
        check_whole(path)


def check_whole(path: Path) -> None:
    """Check that a file is what its name says, to the last scene."""
    if path.suffix == ".npz":
        assert len(load_clip(path).records) == 11
    elif path.suffix == ".mp4":
        ffmpeg = pytest.importorskip("imageio_ffmpeg")
        assert ffmpeg.count_frames_and_secs(str(path))[0] == 11
    elif path.suffix == ".html":
        assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")
    else:
        assert path.suffix == ".rrd", f"{path.name} was left behind"
        reader = pytest.importorskip("rerun.chunk").RrdReader
        assert list(reader(path).stream())


@pytest.mark.filterwarnings("ignore:The ..noload:DeprecationWarning")  # MLflow's own
def test_videos_reach_mlflow(tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow")
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    options = [*RECORD[:3], "mlflow=1", "n_test_rollouts=1", "n_epochs=1", "eval_after_n_steps=40"]
    done = scilab_rl(PIXELS, *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (database,) = (tmp_path / "data").glob("*.db")
    client = mlflow.MlflowClient(f"sqlite:///{database}")
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    (run,) = client.search_runs(experiments)
    names = {artifact.path for artifact in client.list_artifacts(run.info.run_id)}
    videos = sorted(name for name in names if name.endswith(".mp4"))
    assert len(videos) == 2, names  # one of training, one of evaluation
    assert {name.replace(".mp4", ".html") for name in videos} <= names
    for video in videos:
        copy = client.download_artifacts(run.info.run_id, video, str(tmp_path))
        assert ffmpeg.count_frames_and_secs(copy)[0] == 11


def test_videos_reach_wandb_offline(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    done = scilab_rl(
        PIXELS,
        *RECORD,
        "wandb=1",
        "n_epochs=1",
        "eval_after_n_steps=40",
        cwd=tmp_path,
        WANDB_MODE="offline",
    )
    assert done.returncode == 0, done.stderr
    (offline,) = last_run(tmp_path).glob("wandb/offline-run-*")
    videos = sorted((offline / "files" / "media" / "videos").rglob("*.mp4"))
    assert len(videos) == 2
    for video in videos:
        assert ffmpeg.count_frames_and_secs(str(video))[0] == 11


def test_f24_without_opengl_training_goes_on(tmp_path: Path) -> None:
    """The back ends are hidden from the loader of libraries: what is left cannot draw."""
    done = scilab_rl(
        "env=FetchReach",
        *RECORD,
        "n_epochs=1",
        "eval_after_n_steps=50",
        cwd=tmp_path,
        **without_opengl(tmp_path),
    )
    assert done.returncode == 0, done.stderr
    said = [line for line in done.stderr.splitlines() if "No picture can be drawn" in line]
    assert len(said) == 1
    assert "apt-get install" in said[0]
    assert json.loads((last_run(tmp_path) / "result.json").read_text())["status"] == "finished"


def without_opengl(folder: Path) -> dict[str, str]:
    """Return an environment in which libraries of OpenGL are found, but are none."""
    hidden = folder / "libraries"
    hidden.mkdir()
    for name in ("libEGL.so.1", "libGL.so.1", "libGLdispatch.so.0", "libglapi.so.0"):
        (hidden / name).write_bytes(b"no library")
    return {"LD_LIBRARY_PATH": str(hidden), "DISPLAY": "", "WAYLAND_DISPLAY": ""}


@pytest.fixture
def display() -> Iterator[str]:
    """A display of its own, without a screen."""
    program = shutil.which("Xvfb")
    if program is None:
        pytest.skip("needs Xvfb (apt-get install -y xvfb)")
    reading, writing = os.pipe()
    options = ["-displayfd", str(writing), "-screen", "0", "1200x800x24", "-nolisten", "tcp"]
    server = subprocess.Popen(
        [program, *options],
        pass_fds=[writing],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    with os.fdopen(reading) as file:
        number = file.readline().strip()
    assert number, "Xvfb did not start"
    yield f":{number}"
    server.terminate()
    server.wait()


def test_own_window_of_the_environment(display: str, tmp_path: Path) -> None:
    """With render=human, the scene of the evaluation is in a window while it lasts."""
    seen = 0
    options = ["env=FetchReach", "algorithm=random", "render=human", "mlflow=0", "n_epochs=1"]
    with subprocess.Popen(
        command(*options, "eval_after_n_steps=50", "n_test_rollouts=4"),
        cwd=tmp_path,
        env=quiet_environment(DISPLAY=display),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as run:
        while run.poll() is None:
            seen = max(seen, n_colors(display))
            time.sleep(0.2)
    assert run.returncode == 0
    assert seen > 100  # an empty screen has one


def test_window_that_fails_is_replaced_by_the_page(display: str, tmp_path: Path) -> None:
    """The viewer cannot draw with this back end of its own; training hears of it and goes on."""
    pytest.importorskip("rerun")
    done = scilab_rl(
        PIXELS,
        "algorithm=random",
        "render=display",
        "mlflow=0",
        "n_epochs=2",
        "render_freq=1",
        "eval_after_n_steps=20000",
        cwd=tmp_path,
        DISPLAY=display,
        WGPU_BACKEND="none",
    )
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    (number,) = [i for i, line in enumerate(lines) if "No window can be opened (" in line]
    assert "Live view: http://127.0.0.1:" in lines[number + 1]
    assert sum("keeps what it has shown" in line for line in lines) == 1


def test_f33_window_listens_to_this_machine_only(display: str) -> None:
    pytest.importorskip("rerun")
    script = """
import psutil, time
from scilab_rl.recording.live import LiveViewer
viewer = LiveViewer((), window=True)
(window,) = psutil.Process().children()
addresses = set()
deadline = time.monotonic() + 8
while time.monotonic() < deadline and window.is_running() and window.status() != "zombie":
    addresses |= {c.laddr.ip for c in window.net_connections("tcp") if c.status == "LISTEN"}
    time.sleep(0.005)
print(sorted(addresses))
viewer.close()
if window.is_running():
    window.kill()
"""
    environment = quiet_environment(DISPLAY=display)
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout == "['127.0.0.1']\n", done.stderr


def test_f34_stuck_viewer_delays_neither_training_nor_its_end() -> None:
    pytest.importorskip("rerun")
    done = subprocess.run(
        [sys.executable, "-c", WITH_STUCK_VIEWER],
        env=quiet_environment(),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    ended = time.time()
    assert done.returncode == 0, done.stderr
    counts, closed = done.stdout.splitlines()
    n_dropped, longest = (float(word) for word in counts.split())
    assert n_dropped >= 500
    assert longest < 0.1
    assert ended - float(closed) < 6.0  # the viewer's package alone would wait for eleven seconds
    assert done.stderr.count("is too slow") == 1


def n_colors(display: str) -> int:
    """Return how many colors there are on a display, looking at every eighth row."""
    from PIL import ImageGrab

    with ImageGrab.grab(xdisplay=display) as image:
        return len(image.resize((300, 200)).getcolors(60_000) or ())


def test_f25_without_display_a_window_is_refused(tmp_path: Path) -> None:
    done = scilab_rl(
        "env=FetchReach", "render=human", *QUICK, cwd=tmp_path, DISPLAY="", WAYLAND_DISPLAY=""
    )
    assert done.returncode == 2
    assert "render=display" in done.stderr.splitlines()[-1]
    assert not list((tmp_path / "data").glob("*/*"))


def test_f26_without_ffmpeg_page_and_episode_are_kept(tmp_path: Path) -> None:
    options = [PIXELS, *RECORD, "n_epochs=1", "eval_after_n_steps=40"]
    done = scilab_rl(*options, cwd=tmp_path, IMAGEIO_FFMPEG_EXE="/nonexistent", PATH="")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(".mp4 could not be written") == 1
    kept = [path.suffix for path in (last_run(tmp_path) / "episodes").iterdir()]
    assert ".mp4" not in kept
    assert kept.count(".npz") == kept.count(".html") == 2


# Stands for ffmpeg: the real one encodes, and is killed in the middle of the first video.
KILLED_ENCODER = """#!{python}
import os, pathlib, signal, subprocess, sys
encoder, has_killed = [{ffmpeg!r}, *sys.argv[1:]], pathlib.Path({has_killed!r})
if "rawvideo" not in sys.argv or has_killed.exists():
    os.execv(encoder[0], encoder)
has_killed.touch()
process = subprocess.Popen(encoder, stdin=subprocess.PIPE)
process.stdin.write(sys.stdin.buffer.read(1_000_000))
process.stdin.flush()
for victim in (process.pid, os.getpid()):
    os.kill(victim, signal.SIGKILL)
"""


def test_f26_encoder_that_is_killed_costs_one_video(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    encoder, has_killed = tmp_path / "ffmpeg", tmp_path / "has_killed"
    names = {"ffmpeg": ffmpeg.get_ffmpeg_exe(), "has_killed": str(has_killed)}
    encoder.write_text(KILLED_ENCODER.format(python=sys.executable, **names))
    encoder.chmod(0o700)
    options = [PIXELS, *RECORD, "n_epochs=2", "eval_after_n_steps=40"]
    done = scilab_rl(*options, cwd=tmp_path, IMAGEIO_FFMPEG_EXE=str(encoder))
    assert done.returncode == 0, done.stderr
    assert has_killed.exists()
    said = ".mp4 could not be written: ffmpeg ended before the video did. Training continues"
    assert done.stderr.count(said) == done.stderr.count("could not be written") == 1
    run = last_run(tmp_path)
    assert json.loads((run / "result.json").read_text())["status"] == "finished"
    kept = [path for path in (run / "episodes").iterdir() if path.suffix != ".rrd"]
    for path in kept:
        check_whole(path)
    counts = {suffix: sum(p.suffix == suffix for p in kept) for suffix in (".npz", ".html", ".mp4")}
    assert counts == {".npz": 4, ".html": 4, ".mp4": 3}


DRAWINGS = """
import gymnasium, numpy as np

class Drawn(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"]}
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None, kind="picture"):
        self.render_mode, self.kind = render_mode, kind

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.zeros(2, np.float32), float(self.t), False, False, {}

    def render(self):
        if self.kind == "picture":  # transparent floats whose size is odd and grows
            return np.full((31 + self.t, 41, 4), 0.5)
        return None if self.kind == "nothing" else 1 / 0

gymnasium.register("Drawn-v0", entry_point=Drawn, max_episode_steps=10)
"""


@pytest.mark.parametrize(
    ("kind", "vector"),
    [("picture", "inprocess"), ("nothing", "subprocess"), ("error", "inprocess")],
)
def test_whatever_render_returns_the_curves_are_recorded(
    tmp_path: Path, kind: str, vector: str
) -> None:
    (tmp_path / "drawings.py").write_text(DRAWINGS, encoding="utf-8")
    done = scilab_rl(
        "env=drawings:Drawn-v0",
        f"env_kwargs.kind={kind}",
        "n_envs=2",
        f"vector={vector}",
        *RECORD,
        "n_epochs=2",
        "eval_after_n_steps=40",
        "render_metrics_train=[reward]",
        "render_metrics_test=[reward]",
        cwd=tmp_path,
        PYTHONPATH=os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]),
    )
    assert done.returncode == 0, done.stderr
    said = (done.stdout + done.stderr).count("Scenes without picture")
    assert said == (0 if kind == "picture" else 1)
    clips = sorted((last_run(tmp_path) / "episodes").glob("*.npz"))
    assert len(clips) >= 3
    for path in clips:
        check_whole(path.with_suffix(".mp4"))
        check_whole(path.with_suffix(".html"))
        clip = load_clip(path)
        assert clip.curves("reward")[""] == [*map(float, range(1, 11)), None]
        assert all(bool(record.picture) == (kind == "picture") for record in clip.records)
