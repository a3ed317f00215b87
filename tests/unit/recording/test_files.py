"""What is made of a clip: archive, page, video, gallery."""

from __future__ import annotations

import json
import os
import re
import stat
from pathlib import Path

import numpy as np
import pytest

from scilab_rl.errors import ConfigError
from scilab_rl.metrics.probes import Curve
from scilab_rl.metrics.triggers import parse_trigger
from scilab_rl.recording.highlights import HighlightRecorder
from scilab_rl.recording.movie import CardFrames, MovieFrames, n_held, write_side_by_side
from scilab_rl.recording.recorder import ClipRecorder, render_clip_files
from scilab_rl.recording.records import (
    EpisodeOutcome,
    Record,
    decode_picture,
    encode_picture,
    load_clip,
    read_outcomes,
    save_clip,
    value_range,
)
from scilab_rl.recording.replay import write_index, write_replay
from scilab_rl.testing import decode_frame

from .clips import make_clip


def same(left: Record, right: Record) -> bool:
    for name in vars(left):
        a, b = getattr(left, name), getattr(right, name)
        equal = np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b
        if not equal:
            return False
    return True


def test_archive_gives_back_every_record(tmp_path: Path) -> None:
    clip = make_clip()
    save_clip(clip, tmp_path / "x.npz")
    loaded = load_clip(tmp_path / "x.npz")
    assert loaded.info == clip.info
    assert all(map(same, loaded.records, clip.records))
    assert len(loaded.records) == len(clip.records)


def test_archive_keeps_dictionaries_of_observations(tmp_path: Path) -> None:
    clip = make_clip()
    for record in clip.records:
        record.observation = {"achieved_goal": np.full(2, record.step), "desired_goal": np.ones(3)}
    save_clip(clip, tmp_path / "x.npz")
    for record in load_clip(tmp_path / "x.npz").records:
        assert record.observation.keys() == {"achieved_goal", "desired_goal"}
        assert record.observation["achieved_goal"].tolist() == [record.step] * 2


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.npz").write_bytes(b"no zip")
    with pytest.raises(ConfigError, match="is not a recorded episode"):
        load_clip(tmp_path / "x.npz")
    np.savez(tmp_path / "y.npz", about=np.array([{"a": 1}], dtype=object))  # needs pickle
    with pytest.raises(ConfigError, match="is not a recorded episode"):
        load_clip(tmp_path / "y.npz")


def test_page_is_one_file_whose_data_cannot_end_it(tmp_path: Path) -> None:
    clip = make_clip(panels=("</script><b>", "reward"))
    clip.records[0].values[Curve("</script><b>")] = 1.0
    write_replay(clip, tmp_path / "x.html")
    page = (tmp_path / "x.html").read_text()
    assert page.count("</script>") == 2
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", page)
    data = json.loads(re.search(r'id="clip">(.*?)</script>', page, re.DOTALL)[1])  # type: ignore[index]
    assert data["steps"] == [0, 1, 2, 3, 4]
    assert data["panels"][1]["curves"] == [{"label": "", "values": [0.0, None, 2.0, 3.0, None]}]
    assert data["events"][3] == ["success"]
    assert data["outcomes"] == {"3": {"success": True, "return": 6.0, "steps": 4, "complete": True}}
    assert data["rate"] == 10.0  # an episode of four steps is shown slower than in real time


@pytest.mark.parametrize("n_panels", range(17))
def test_each_panel_has_its_own_place_on_the_sheet(n_panels: int) -> None:
    names = tuple(f"m{index}" for index in range(n_panels))
    clip = make_clip(names)
    for record in clip.records[:-1]:
        record.values = dict.fromkeys(map(Curve, names), 1.0)
    frames = MovieFrames(clip)
    frame = frames[2]
    assert frame.shape == (frames.size[1], frames.size[0], 3)
    assert all(side % 2 == 0 for side in frames.size)
    if frames.sheet is None:
        assert n_panels == 0
        return
    assert [panel.name for panel in frames.sheet.panels] == list(names)
    width, height = frames.sheet.size
    taken = np.zeros((height, width), int)
    for panel in frames.sheet.panels:
        assert 0 < panel.left < panel.right < width
        assert 0 < panel.top < panel.bottom < height
        taken[panel.top : panel.bottom, panel.left : panel.right] += 1
    assert taken.max() == 1


def test_curves_are_drawn_only_up_to_the_scene() -> None:
    frames = MovieFrames(make_clip(("q_values",), n_steps=20))
    assert frames.sheet is not None
    panel = frames.sheet.panels[0]

    def n_colored(index: int) -> tuple[int, int]:
        pixels = np.asarray(frames.sheet.until(index)).astype(int)  # type: ignore[union-attr]
        is_colored = np.ptp(pixels, axis=2) > 60
        area = is_colored[panel.top - 4 : panel.bottom + 4]
        cursor = panel.left + round(index / 20 * (panel.right - panel.left))
        return int(area[:, panel.left : cursor - 4].sum()), int(area[:, cursor + 5 :].sum())

    before, after = zip(*(n_colored(index) for index in (2, 10, 18)), strict=True)
    assert 0 < before[0] < before[1] < before[2]
    assert after == (0, 0, 0)


def test_the_name_of_an_event_is_written_from_its_scene_on() -> None:
    clip = make_clip(("reward",), n_steps=40)
    for record in clip.records:
        record.events = ["success"] if record.step in (38, 39) else []
    frames = MovieFrames(clip)
    top = np.s_[: frames.sheet.panels[0].top + 14, :-60]  # left of the event, high up

    def n_green(index: int) -> int:
        r, g, b = np.asarray(frames.sheet.until(index))[top].astype(int).transpose(2, 0, 1)
        return int(((g - r > 60) & (g - b > 20)).sum())

    counts = [n_green(index) for index in (30, 37, 38, 39)]
    assert counts[:2] == [0, 0]
    assert counts[2] > 5
    assert counts[3] == counts[2]  # the second name would cover the first


def test_ranges_are_those_of_the_whole_clip() -> None:
    assert value_range([[0.0, 10.0], [None, -10.0]]) == pytest.approx((-11.2, 11.2))
    assert value_range([[5.0, 5.001]]) == pytest.approx((0.0, 6.25125))
    assert value_range([[0.0, 2e-6], [1e-6, None]])[0] == 0.0  # no variance is negative
    assert make_clip(("success",)).range("success") == (0.0, 1.0)


def test_critics_have_names_and_other_numbers_have_theirs() -> None:
    assert list(make_clip().curves("q_values")) == ["critic 1", "critic 2"]
    clip = make_clip(("custom.x",))
    clip.records[0].values = {Curve("custom.x", "arm 0"): 1.0}
    assert list(clip.curves("custom.x")) == ["arm 0"]


def test_outcomes_are_read_without_the_pictures(tmp_path: Path) -> None:
    clip = make_clip()
    save_clip(clip, tmp_path / "x.npz")
    info, outcomes = read_outcomes(tmp_path / "x.npz")
    assert info == clip.info
    assert outcomes == clip.outcomes() == {3: EpisodeOutcome(6.0, 4, True, True)}
    clip.records = clip.records[2:]
    assert clip.outcomes() == {3: EpisodeOutcome(5.0, 2, True, False)}
    assert clip.outcomes()[3].text() == "part of an episode"


def test_the_index_lists_all_pages_of_a_folder(tmp_path: Path) -> None:
    for name in ("eval_epoch_0001_episode_00003", "play_001"):
        clip = make_clip()
        save_clip(clip, tmp_path / f"{name}.npz")
        (tmp_path / f"{name}.html").write_text("")
    save_clip(make_clip(), tmp_path / "without_page.npz")
    (tmp_path / "broken.npz").write_bytes(b"no zip")
    (tmp_path / "broken.html").write_text("")
    text = write_index(tmp_path).read_text(encoding="utf-8")
    assert re.findall(r'<option value="(.*?)">(.*?)</option>', text) == [
        ("eval_epoch_0001_episode_00003", "epoch 1, episode 3: success, return 6, 4 steps"),
        ("play_001", "play 001: success, return 6, 4 steps"),
    ]


@pytest.fixture(scope="module")
def developed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clip") / "x.npz"
    save_clip(make_clip(large=True), path)
    assert {file.suffix for file in render_clip_files(path)} >= {".mp4", ".html"}
    return path


def test_video_has_one_frame_per_scene_and_holds_the_last(developed: Path) -> None:
    import imageio_ffmpeg

    n_frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(developed.with_suffix(".mp4")))
    assert n_held(load_clip(developed)) == 15
    assert (n_frames, seconds) == (20, pytest.approx(2.0, abs=0.1))


def test_picture_of_a_large_frame_survives_jpeg() -> None:
    picture = make_clip(large=True).records[4].picture
    assert picture.startswith(b"\xff\xd8")
    pixels = decode_picture(picture).reshape(64, 5, 128, 5, 3).mean(axis=(1, 3))
    assert decode_frame(pixels) == (3, 4)


def test_without_ffmpeg_the_page_is_still_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(broken))
    save_clip(make_clip(), tmp_path / "x.npz")
    with pytest.raises(RuntimeError, match=r"\.mp4 could not be written"):
        render_clip_files(tmp_path / "x.npz")
    assert (tmp_path / "x.html").is_file()


def test_recorder_writes_in_the_background_and_tells(tmp_path: Path) -> None:
    told: list[Path] = []
    recorder = ClipRecorder(tmp_path / "episodes", told.append)
    clip = make_clip()
    recorder.begin(clip.info)
    for record in clip.records:
        recorder.add(record)
    recorder.end()
    recorder.begin(clip.info)
    recorder.end()  # nothing happened in it
    recorder.close()
    assert recorder.recordings == [tmp_path / "episodes" / f"{clip.info.name}.npz"]
    assert {path.suffix for path in told} >= {".mp4", ".html"}


def test_highlights_are_cut_out_and_ranked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scilab_rl.recording.recorder.render_clip_files", lambda path: [])
    moments = HighlightRecorder(ClipRecorder(tmp_path), parse_trigger("reward > 100"))
    clip = make_clip(n_steps=300)
    for record in clip.records:
        record.values[Curve("reward")] = {90: 150.0, 95: 160.0, 250: 400.0}.get(record.step, 0.0)
    moments.begin(clip.info)
    for record in clip.records:
        moments.add(record)
    moments.end()
    moments.close()
    assert [(m.record.step, m.score) for m in moments.highlights] == [(95, 60.0), (250, 300.0)]
    kept = [load_clip(path) for path in sorted(tmp_path.glob("*.npz"))]
    assert [(c.records[0].step, c.records[-1].step) for c in kept] == [(45, 145), (200, 300)]
    page = (tmp_path / "highlights.html").read_text()
    assert re.findall(r'href="(.*?)"', page) == [
        f"{clip.info.name}_moment_0250.html#50",
        f"{clip.info.name}_moment_0095.html#50",
    ]
    assert "reward &gt; 100" in page


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_that_cannot_be_written_ends_no_training(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    recorder = ClipRecorder(tmp_path / "episodes")
    recorder.begin(make_clip().info)
    recorder.add(make_clip().records[0])
    recorder.end()
    recorder.close()
    assert recorder.recordings == []


def test_page_names_the_unit_of_a_metric_that_has_one(tmp_path: Path) -> None:
    clip = make_clip(("entropy", "reward"))
    write_replay(clip, tmp_path / "x.html")
    page = (tmp_path / "x.html").read_text(encoding="utf-8")
    assert '"name": "entropy (nats)"' in page
    assert '"name": "reward"' in page


def test_the_font_has_what_panels_write() -> None:
    from scilab_rl.drawing import font
    from scilab_rl.recording.movie import NO_VALUE

    font = font(12)
    missing = bytes(font.getmask("\ue123"))  # of a letter that no font has
    written = {*"0123456789.e+…:", *NO_VALUE}
    assert [letter for letter in written if bytes(font.getmask(letter)) == missing] == []


def test_success_is_marked_in_the_scenes_that_follow_it() -> None:
    green = (5, 150, 105)
    clip = make_clip(large=True)
    frames = MovieFrames(clip)
    left, top = frames.scene_corner
    edges = [tuple(frames[index][top + 1, left + 40]) for index in range(5)]
    assert [edge == green for edge in edges] == [False, False, False, False, True]


def test_clips_side_by_side_have_one_axis_and_wait_for_the_longest(tmp_path: Path) -> None:
    import imageio_ffmpeg

    clips = [make_clip(("reward",), n_steps=2, large=True), make_clip(("reward",), large=True)]
    write_side_by_side(clips, ["before", "after"], "reward", tmp_path / "x.mp4")
    n_frames, _ = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "x.mp4"))
    assert n_frames == 5 + n_held(clips[1])
    span = value_range([[0.0, 3.0]])
    assert CardFrames(clips[0], "reward", "before", span).sheet.panels[0].high == span[1]


def without_pictures(clip, steps):
    for record in clip.records:
        if record.step in steps:
            record.picture = b""
    return clip


def test_scenes_without_picture_keep_curves_and_numbers_in_every_file(tmp_path: Path) -> None:
    clip = without_pictures(make_clip(), range(5))
    save_clip(clip, tmp_path / "x.npz")
    loaded = load_clip(tmp_path / "x.npz")
    assert [record.picture for record in loaded.records] == [b""] * 5
    assert loaded.curves("reward") == make_clip().curves("reward")
    frames = MovieFrames(loaded)
    assert [image.shape for image in frames] == [(512, 640, 3)] * 5
    assert not np.array_equal(frames[1][32:], frames[4][32:])  # the curves go on
    write_replay(loaded, tmp_path / "x.html")
    assert '"pictures": ["", "", "", "", ""]' in (tmp_path / "x.html").read_text()
    assert MovieFrames(without_pictures(make_clip(panels=()), range(5)))[0].shape == (512, 640, 3)


def test_a_scene_without_picture_leaves_its_place_empty() -> None:
    frames = MovieFrames(without_pictures(make_clip(large=True), [2]))
    scene = np.s_[40:500, 8:300]
    assert (frames[2][scene] == 255).all()
    assert not (frames[1][scene] == 255).all()


def test_a_frame_that_grows_is_drawn_to_one_scale_and_a_thin_one_is_seen() -> None:
    clip = make_clip(panels=(), n_steps=2)
    for record, height in zip(clip.records, (30, 60, 120), strict=True):
        record.picture = encode_picture(np.zeros((height, 120, 3), np.uint8))
    heights = [int((frame[40:, 240, 0] < 128).sum()) for frame in MovieFrames(clip)]
    assert heights == [120, 240, 472]  # of 480; the header's share is not counted
    for record in clip.records:
        record.picture = encode_picture(np.zeros((1, 4000, 3), np.uint8))
    assert (MovieFrames(clip)[0][40:] < 128).any()
