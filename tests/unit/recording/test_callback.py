"""Which epochs are shown: the first, then every few, of training and of evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from scilab_rl.recording.callback import record_episodes
from scilab_rl.recording.records import ClipInfo, Record
from scilab_rl.tracking.base import TrackerGroup
from scilab_rl.training.callbacks import RunCallback
from tests.unit.training.test_callbacks import make_trainer


class Names:
    """Keeps the names of clips and the numbers of their scenes."""

    def __init__(self) -> None:
        self.clips: dict[str, int] = {}
        self.is_closed = False

    def begin(self, clip: ClipInfo) -> None:
        self.name = clip.name
        self.clips[clip.name] = 0

    def add(self, record: Record) -> None:
        self.clips[self.name] += 1

    def end(self) -> None:
        pass

    def close(self) -> None:
        self.is_closed = True


def config(**keys: object) -> Mapping[str, object]:
    shown = {"render_metrics_train": ("reward",), "render_metrics_test": ("reward",)}
    return {"render": "record", "render_freq": 2, "n_epochs": 4, **shown, **keys}


@pytest.mark.parametrize(("render", "is_shown"), [("none", False), ("record", True)])
def test_without_rendering_there_is_no_callback(
    render: str, is_shown: bool, tmp_path: Path
) -> None:
    trainer = make_trainer(tmp_path, **config(render=render))
    recording = record_episodes(trainer.cfg, trainer, TrackerGroup([]), tmp_path)
    assert isinstance(recording, RunCallback) is is_shown


def test_the_first_and_every_second_epoch_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = Names()
    monkeypatch.setattr("scilab_rl.recording.callback._make_sink", lambda *_: sink)
    trainer = make_trainer(tmp_path, **config())
    recording = record_episodes(trainer.cfg, trainer, TrackerGroup([]), tmp_path)
    assert recording is not None
    trainer.callbacks.insert(0, recording)
    trainer.learn()
    trainer.close()
    phases = [(name.split("_")[0], int(name.split("_")[2])) for name in sink.clips]
    assert phases == [
        ("train", 1),
        ("eval", 1),
        ("train", 2),
        ("eval", 2),
        ("train", 4),
        ("eval", 4),
    ]
    assert sink.is_closed
    assert all(n > 1 for n in sink.clips.values())
