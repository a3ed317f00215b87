from __future__ import annotations

import json

import pytest
import yaml

from scilab_rl.run.directory import RunDirectory
from scilab_rl.run.provenance import fingerprint_differences


@pytest.fixture
def make_run(tmp_path):
    def make(fingerprint: str | None, mujoco: str = "3.3.0", **config) -> RunDirectory:
        path = tmp_path / str(len(list(tmp_path.iterdir())))
        path.mkdir()
        settings = {"env": "FetchReach-v4", "env_kwargs": {}, "wrappers": [], "seed": 3} | config
        (path / "config.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        source = {"fingerprint": fingerprint, "versions": {"mujoco": mujoco, "rich": mujoco}}
        (path / "provenance.json").write_text(json.dumps(source), encoding="utf-8")
        return RunDirectory(path)

    return make


def test_the_same_environment_is_no_difference(make_run) -> None:
    assert fingerprint_differences([]) == []
    assert fingerprint_differences([make_run("aa"), make_run("aa", seed=4)]) == []


def test_a_difference_is_one_line_with_the_versions_that_explain_it(make_run) -> None:
    runs = [make_run("aa", "3.6.0"), make_run("bb"), make_run("bb")]
    assert fingerprint_differences(runs) == [
        "FetchReach-v4 did not behave the same in these runs, so their results do not compare: "
        "its fingerprints (runs) are bb (2), aa (1). Versions differ: mujoco 3.3.0 / 3.6.0."
    ]


def test_a_difference_without_an_explanation(make_run) -> None:
    (line,) = fingerprint_differences([make_run("aa"), make_run("bb")])
    assert line.endswith("are aa (1), bb (1).")


@pytest.mark.parametrize(
    "other",
    [
        {"env": "FetchPush-v4"},
        {"env_kwargs": {"reward_type": "dense"}},
        {"wrappers": [{"_target_": "gymnasium.wrappers.TimeAwareObservation"}]},
        {"flatten_obs": 1},
    ],
)
def test_environments_that_are_told_to_differ_may(make_run, other) -> None:
    assert fingerprint_differences([make_run("aa"), make_run("bb", **other)]) == []


def test_damaged_and_old_runs_are_left_out(make_run) -> None:
    without, broken, odd = make_run(None), make_run("bb"), make_run("cc")
    (broken / "config.yaml").write_text(": [", encoding="utf-8")
    (odd / "provenance.json").write_text("[]", encoding="utf-8")
    assert fingerprint_differences([make_run("aa"), without, broken, odd]) == []
