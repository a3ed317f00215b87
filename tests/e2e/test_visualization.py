"""What is drawn belongs to the scene it is drawn beside: proven from the files themselves.

TinyPixels writes its own episode and step into its pixels. Probes and the algorithm's own records
tell what they were computed for. Both are read back from the video, the page and the viewer's
recording, and must agree in every scene.
"""

from __future__ import annotations

import dataclasses
import io
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scilab_rl.drawing import COLORS
from scilab_rl.metrics.probes import Curve
from scilab_rl.recording import movie
from scilab_rl.recording.live import LiveViewer
from scilab_rl.recording.movie import HEADER, MovieFrames
from scilab_rl.recording.records import (
    Clip,
    ClipInfo,
    Record,
    decode_picture,
    encode_picture,
    load_clip,
)
from scilab_rl.testing import decode_frame

from .chromium import EXECUTABLE, Chromium
from .commands import last_run, quiet_environment

pytestmark = pytest.mark.slow

ENV = "scilab_rl.testing:TinyPixels-v0"
N_STEPS = 10  # of an episode of TinyPixels
# The algorithm says before and after `env.step` which step it is at.
ALGORITHM = """
    from scilab_rl.algorithms.random import RANDOM


    class COUNTING(RANDOM):
        metrics = (
            "train/step_before", "train/step_after", "train/episode_lazily", "train/after_update",
        )

        def iterate(self, callback):
            callback.on_rollout_start()
            episode, step = self._last_obs[0]
            self.logger.record("train/step_before", step)
            self.logger.record_lazy("train/episode_lazily", lambda: episode)
            actions = self.sample_env_actions()
            if self.step(actions, callback) is None:
                return False
            callback.on_rollout_end()
            self.logger.record("train/after_update", step)
            return True

        def step(self, actions, callback):
            step = self._last_obs[0][1]

            class Recording:
                def __getattr__(_, name):
                    return getattr(callback, name)

                def on_step(_):
                    self.logger.record("train/step_after", step)
                    return callback.on_step()

            return super().step(actions, Recording())
"""
PROBES = """
    def episode(algorithm, observation):
        return observation[0]

    def step(algorithm, observation):
        return observation[1]

    def next_step(algorithm, observation, action, reward, next_observation):
        return next_observation[1]

    def some(algorithm, observation, action):
        return observation[1] if observation[1] % 2 else None

    class Calls:
        def __init__(self):
            self.n = 0

        def __call__(self, algorithm, observation):
            self.n += 1
            return self.n
"""
OWN = [f"custom_probes.{name}" for name in ("episode", "step", "next_step", "some", "Calls")]
RECORDED = [f"train/{name}" for name in ("step_before", "step_after", "episode_lazily")]


@pytest.fixture(scope="module", params=[1, 4])
def clips(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The recordings of a run with two epochs, both rendered."""
    project = tmp_path_factory.mktemp(f"project{request.param}")
    (project / "src" / "custom_algorithms").mkdir(parents=True)
    (project / "conf" / "algorithm").mkdir(parents=True)
    (project / "src" / "custom_algorithms" / "__init__.py").touch()
    (project / "src" / "custom_algorithms" / "counting.py").write_text(textwrap.dedent(ALGORITHM))
    (project / "src" / "custom_probes.py").write_text(textwrap.dedent(PROBES))
    (project / "conf" / "algorithm" / "counting.yaml").write_text(
        "name: counting\n_target_: custom_algorithms.counting.COUNTING\n"
    )
    own = ",".join(OWN)
    done = run(
        project,
        "algorithm=counting",
        f"env={ENV}",
        "render=record",
        "render_freq=1",
        f"render_metrics_train=[{own},reward,return_so_far,{','.join(RECORDED)}]",
        f"render_metrics_test=[{own},reward,return_so_far,eval/rollout_rewards_step]",
        f"n_envs={request.param}",
        "n_epochs=2",
        "eval_after_n_steps=100",
        "n_test_rollouts=2",
        "mlflow=0",
    )
    assert done.returncode == 0, done.stderr
    recordings = sorted((last_run(project) / "episodes").glob("*.npz"))
    assert [path.name.partition("_")[0] for path in recordings] == ["eval"] * 2 + ["train"] * 2
    return recordings


def run(project: Path, *arguments: str) -> subprocess.CompletedProcess:
    """Run the installed program: src/main.py would find its own project first."""
    return subprocess.run(
        [sys.executable, "-m", "scilab_rl.cli.main", *arguments],
        cwd=project,
        env=quiet_environment(),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def expected(episode: int, step: int, phase: str) -> dict[str, float]:
    """Return all numbers of a scene, from nothing but the numbers in its pixels."""
    values: dict[str, float] = {
        "custom_probes.episode": episode,
        "custom_probes.step": step,
        "custom_probes.Calls": step + 1,
    }
    if step == N_STEPS:  # nothing is done in the last scene
        return values
    reward = episode + (step + 1) / 100
    values |= {
        "custom_probes.next_step": step + 1,
        "reward": reward,
        "return_so_far": sum(episode + (i + 1) / 100 for i in range(step + 1)),
    }
    if step % 2:
        values["custom_probes.some"] = step
    if phase == "eval":
        values["eval/rollout_rewards_step"] = reward
    else:
        values |= {name: step for name in ("train/step_before", "train/step_after")}
        values["train/episode_lazily"] = episode
    return values


def test_recorded_numbers_belong_to_their_frame(clips: list[Path]) -> None:
    for path in clips:
        clip = load_clip(path)
        assert len(clip.records) == N_STEPS + 1
        for index, record in enumerate(clip.records):
            episode, step = decode_frame(decode_picture(record.picture))
            assert step == record.step == index
            np.testing.assert_array_equal(record.observation, [episode, step])
            wanted = expected(episode, step, record.phase)
            shown = {curve.panel: number for curve, number in record.values.items()}
            assert shown == pytest.approx(wanted, rel=1e-6), (path.name, step)
            assert record.values.keys() == set(map(Curve, wanted))


def test_page_shows_the_numbers_of_its_scene(clips: list[Path]) -> None:
    if EXECUTABLE is None:
        pytest.skip("needs chromium")
    pytest.importorskip("aiohttp")
    with Chromium() as browser:
        for path in clips:
            browser.open(path.with_suffix(".html").as_uri() + "#0")  # does not play by itself
            browser.wait_for("pictures.every(picture => picture.complete)")
            for step in range(N_STEPS + 1):
                pixels = np.array(browser.evaluate(_SCENE_PIXELS), np.uint8)
                episode, shown_step = decode_frame(pixels.reshape(64, 128, 4)[:, :, :3])
                assert shown_step == step
                assert browser.evaluate("$('step').textContent") == f"step {step}"
                texts = dict(browser.evaluate(_PANEL_TEXTS))
                wanted = expected(episode, step, path.name.partition("_")[0])
                for name, text in texts.items():
                    if name in wanted:
                        near = pytest.approx(wanted[name], rel=6e-4, abs=6e-4)  # four digits
                        assert float(text) == near, (name, step)
                    else:
                        assert text == "–", (name, step)
                assert wanted.keys() <= texts.keys()
                browser.press("ArrowRight")


def test_page_plays_once_and_gives_its_numbers_and_two_are_side_by_side(clips: list[Path]) -> None:
    if EXECUTABLE is None:
        pytest.skip("needs chromium")
    pytest.importorskip("aiohttp")
    path = clips[0]
    with Chromium() as browser:
        browser.open(path.with_suffix(".html").as_uri())
        browser.wait_for(f"now === {N_STEPS} && timer === null")
        rows = browser.evaluate("table()").splitlines()
        assert rows[0].split(",")[:2] == ["episode", "step"]
        assert len(rows) == N_STEPS + 2
        assert browser.evaluate("picture().toDataURL().length") > 10_000
        browser.open(path.with_name("index.html").as_uri())
        browser.evaluate("document.getElementById('both').click()")
        steps = "frames.map(frame => frame.contentWindow !== null && !frame.hidden)"
        assert browser.evaluate(steps) == [True, True]
        listed = browser.evaluate("known")
        assert sorted(listed) == sorted(clip.stem for clip in path.parent.glob("*.npz"))


def test_live_view_draws_scene_and_curves_in_the_browser() -> None:
    pytest.importorskip("rerun")
    pytest.importorskip("aiohttp")
    if EXECUTABLE is None:
        pytest.skip("needs chromium")
    info = ClipInfo("x", "eval", 1, "Tiny-v0", "sac", 25.0, ("reward",))
    picture = encode_picture(np.full((480, 480, 3), (255, 0, 255), np.uint8))
    viewer = LiveViewer(info.panels, window=False)
    try:
        viewer.begin(info)
        for step in range(30):
            record = Record("eval", 0, 0, step, step, picture, np.zeros(1), np.zeros(1), 1.0)
            record.values = {Curve("reward"): float(step)}
            viewer.add(record)

        def n_pixels(color: tuple[int, int, int]) -> int:
            with Image.open(io.BytesIO(browser.screenshot())) as image:
                pixels = np.asarray(image.convert("RGB")).astype(int)
            return int((np.abs(pixels - color).max(axis=2) < 40).sum())

        with Chromium() as browser:
            browser.open(str(viewer.address))
            browser.wait_until(lambda: n_pixels((255, 0, 255)) > 100_000, seconds=90)
            browser.wait_until(lambda: n_pixels((37, 99, 235)) > 200, seconds=30)
    finally:
        viewer.close()


_SCENE_PIXELS = """(async () => {
    const image = document.getElementById("scene");
    await image.decode();
    const canvas = document.createElement("canvas");
    canvas.width = 128; canvas.height = 64;
    canvas.getContext("2d").drawImage(image, 0, 0);
    return Array.from(canvas.getContext("2d").getImageData(0, 0, 128, 64).data);
})()"""
_PANEL_TEXTS = """[...document.querySelectorAll(".panel")].map(
    panel => [panel.querySelector("h2").textContent, panel.querySelector(".values").textContent])"""


def test_viewer_recording_holds_the_numbers_of_its_scene(clips: list[Path]) -> None:
    reader = pytest.importorskip("rerun.chunk").RrdReader
    for path in clips:
        phase = path.name.partition("_")[0]
        scenes, numbers = _viewer_columns(reader(path.with_suffix(".rrd")))
        assert sorted(scenes) == list(range(N_STEPS + 1))
        for index, picture in scenes.items():
            episode, step = decode_frame(decode_picture(picture))
            assert step == index
            shown = {
                name: values[index] for name, values in numbers.items() if values[index] is not None
            }
            assert shown == pytest.approx(expected(episode, step, phase), rel=1e-6)


@pytest.mark.parametrize("n_panels", range(1, 17))
def test_video_draws_the_numbers_of_its_scene(
    clips: list[Path], n_panels: int, tmp_path: Path
) -> None:
    """All panel counts, terminal and first scenes: the dot of each curve is where it must be."""
    for path in (clips[0], clips[-1]):  # one of evaluation, one of training
        clip = _with_panels(load_clip(path), n_panels)
        video = tmp_path / f"{path.stem}.mp4"
        movie.write_movie(clip, video)
        layout = MovieFrames(clip)
        assert layout.sheet is not None
        assert len(layout.sheet.panels) == n_panels
        frames = _frames_of(video, layout.size)
        assert len(frames) == N_STEPS + 1 + movie.n_held(clip)
        for frame in frames:
            episode, step = decode_frame(_scene_of(frame, layout))
            wanted = expected(episode, step, clip.info.phase)
            for panel in layout.sheet.panels:
                value = wanted.get(re.sub(r"#\d+$", "", panel.name))
                x = panel.left + step / N_STEPS * (panel.right - panel.left)
                if value is not None:
                    assert _has_dot(frame, layout, x, panel.y(value)), (panel.name, step)


def _with_panels(clip: Clip, n_panels: int) -> Clip:
    """Return the clip with this many panels; there are fewer metrics, so that they repeat."""
    names = [clip.info.panels[i % len(clip.info.panels)] for i in range(n_panels)]
    new_names = [f"{name}#{index}" for index, name in enumerate(names)]
    records = [
        dataclasses.replace(
            record,
            values={
                Curve(new): record.values[Curve(name)]
                for new, name in zip(new_names, names, strict=True)
                if Curve(name) in record.values
            },
        )
        for record in clip.records
    ]
    return Clip(dataclasses.replace(clip.info, panels=tuple(new_names)), records)


def _frames_of(video: Path, size: tuple[int, int]) -> np.ndarray:
    """Decode a video. Shapes: ``(n_frames, height, width, 3)``."""
    import imageio_ffmpeg

    program = imageio_ffmpeg.get_ffmpeg_exe()
    raw = ["-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run([program, "-i", str(video), *raw], capture_output=True, check=True)
    return np.frombuffer(decoded.stdout, np.uint8).reshape(-1, size[1], size[0], 3)


def _scene_of(frame: np.ndarray, layout: MovieFrames) -> np.ndarray:
    left, top = layout.scene_corner
    width, height = layout.scene_size
    scene = Image.fromarray(frame[top : top + height, left : left + width])
    return np.asarray(scene.resize((128, 64), Image.Resampling.BOX))


def _has_dot(frame: np.ndarray, layout: MovieFrames, x: float, y: float) -> bool:
    """Return whether the middle of a curve's dot is here, after video compression."""
    row, column = round(y) + HEADER, round(x) + layout.scene_size[0]
    middle = frame[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)
    red, green, blue = (int(COLORS[0][i : i + 2], 16) for i in (1, 3, 5))
    return bool(np.abs(middle - [red, green, blue]).max() < 60)


def _viewer_columns(
    reader: object,
) -> tuple[dict[int, bytes], dict[str, dict[int, float | None]]]:
    """Return pictures and numbers of a recording by their place on the timeline ``step``."""
    scenes: dict[int, bytes] = {}
    numbers: dict[str, dict[int, float | None]] = {}
    for chunk in reader.stream():  # type: ignore[attr-defined]
        if chunk.is_static or "step" not in chunk.timeline_names:
            continue
        table = chunk.to_record_batch().to_pydict()
        steps = table["step"]
        for column, cells in table.items():
            if column.endswith(":blob"):
                scenes |= {s: bytes(c[0]) for s, c in zip(steps, cells, strict=True) if c}
            if column.endswith(":scalars"):
                name = chunk.entity_path.removeprefix("/metrics/").replace("\\", "")
                values = numbers.setdefault(name, {})
                for step, cell in zip(steps, cells, strict=True):
                    values[step] = None if np.isnan(cell[0]) else float(cell[0])
    return scenes, numbers


def test_recorded_names_are_refused_at_evaluation_and_the_probe_is_named(tmp_path: Path) -> None:
    """Nothing is recorded while nothing is learned; the probe answers for the very step."""
    done = run(
        tmp_path,
        "algorithm=cleansac",
        "env=FetchReach",
        "render=record",
        "render_metrics_test=[train/target_critic_variance]",
        "mlflow=0",
    )
    assert done.returncode == 2
    assert done.stderr.strip().endswith("that is shown: 'critic_variance'.")
