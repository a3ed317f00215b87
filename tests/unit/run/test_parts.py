"""Which saved policy a run starts from."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from scilab_rl.run import parts


@pytest.fixture
def restored(tmp_path, monkeypatch):
    """Return a function that tells which policy would be loaded for a value of the key."""
    run = tmp_path / "2026-01-02" / "100000-E-sac-s1-0a1f"
    for name in ("rl_model_best", "rl_model_finished"):
        (run / name).mkdir(parents=True)
    (run / "config.yaml").write_text("env: E-v0\n")
    (tmp_path / "last").symlink_to(run)
    loaded = []
    monkeypatch.setattr(
        "scilab_rl.training.policy.load_policy", lambda _, path: loaded.append(Path(path).resolve())
    )

    def restore(value: str) -> str:
        cfg = SimpleNamespace(restore_policy=value, base_logdir=str(tmp_path))
        parts.restore_policy(cfg, None)
        return loaded[-1].relative_to(tmp_path).as_posix()

    return restore, run


def test_a_run_stands_for_its_last_policy(restored):
    restore, run = restored
    finished = "2026-01-02/100000-E-sac-s1-0a1f/rl_model_finished"
    assert {restore(name) for name in ("0a1f", "last", str(run))} == {finished}
    assert restore(str(run / "rl_model_best")).endswith("/rl_model_best")
    assert restore(str(run.parent.parent / "model.zip")) == "model.zip"
