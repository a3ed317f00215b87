import json
import logging

import pytest

from scilab_rl.cli import runs
from scilab_rl.errors import ConfigError
from scilab_rl.results import RunResult
from scilab_rl.run.annotations import write_annotations
from scilab_rl.run.directory import CONFIG_FILE, RESULT_FILE

from .conftest import read_json, read_table

EVALUATED = {"eval/success_rate": 0.9, "eval/mean_reward": -12.34}


def result(status: str = "finished", metrics: dict | None = None, **other) -> RunResult:
    numbers = {"score": 0.9, "epochs": 3, "steps": 6000, "seconds": 3723.5, "run_dir": ""} | other
    return RunResult(status=status, metrics=EVALUATED if metrics is None else metrics, **numbers)


@pytest.fixture
def listed(tmp_path, capsys):
    """Return a function that lists the runs with these options."""

    def run(*options: str) -> list[dict]:
        assert runs.main([*options, "--json", "--base-logdir", str(tmp_path / "data")]) == 0
        return read_json(capsys.readouterr().out)

    return run


def test_a_run_is_one_line(make_run, tmp_path, capsys):
    make_run("100000-a", result())
    runs.main(["--base-logdir", str(tmp_path / "data")])
    assert read_table(capsys.readouterr().out) == [
        {
            "run": "100000-a",
            "id": "100000-a",
            "started": "2026-01-02 10:00",
            "env": "FetchReach-v4",
            "algorithm": "sac",
            "seed": "7",
            "status": "finished",
            "success": "0.9",
            "reward": "-12.3",
            "epochs": "3",
            "steps": "6000",
            "time": "1:02:03",
        }
    ]


def test_filters(make_run, listed):
    make_run("100000-a", result())
    make_run("110000-b", result("failed", error="boom"), env="FetchPushDense-v4")
    make_run("120000-c", result("solved"), algorithm={"name": "ppo"})
    names = lambda *options: [row["run"][-1] for row in listed(*options)]  # noqa: E731
    assert names() == ["a", "b", "c"]
    assert names("--env", "fetchreach") == ["a", "c"]
    assert names("--env", "FetchPush*") == ["b"]
    assert names("--env", "FetchPush") == []
    assert names("--algorithm", "ppo") == ["c"]
    assert names("--status", "failed") == ["b"]
    assert names("--last", "2") == ["b", "c"]
    assert names("--last", "1", "--algorithm", "sac") == ["b"]


def test_the_reason_of_a_failure_is_shown(make_run, listed):
    make_run("100000-a", result("failed", error="NaN in the critic"))
    assert listed()[0]["problem"] == "NaN in the critic"


def test_a_running_run_shows_its_last_epoch(make_run, listed):
    run = make_run("100000-a", result("running", {}, epochs=0, steps=0, seconds=0.0))
    lines = (
        '{"kind": "epoch", "epoch": 4, "step": 800, "eval/success_rate": 0.25}',
        '{"kind": "episode", "step": 850}',
        '{"kind": "ep',
    )
    (run / "metrics.jsonl").write_text("\n".join(lines), encoding="utf-8")
    with run.in_use():
        row = listed()[0]
    assert (row["status"], row["epochs"], row["steps"], row["success"]) == ("running", 4, 800, 0.25)
    assert listed()[0]["status"] == "crashed"


@pytest.mark.parametrize(
    ("file", "content"),
    [
        (CONFIG_FILE, b""),
        (CONFIG_FILE, b"env: [unclosed"),
        (CONFIG_FILE, b"\xff\xfe\x00"),
        (CONFIG_FILE, b"just a text"),
        (CONFIG_FILE, b"!!python/object/apply:os.system ['true']"),
        (RESULT_FILE, b'{"status": "fin'),
        (RESULT_FILE, b"[]"),
        (RESULT_FILE, b'{"unknown": 1}'),
    ],
)
def test_a_damaged_run_is_listed_as_such(make_run, listed, file, content):
    run = make_run("100000-a", result())
    (run / file).write_bytes(content)
    make_run("110000-b", result())
    damaged, whole = listed()
    assert damaged["status"] == "damaged"
    assert file in damaged["problem"]
    assert whole["status"] == "finished"


@pytest.mark.parametrize("content", ["3\n", "\x00\x01", '{"kind": "epoch"}'])
def test_damaged_metrics_do_not_stop_the_list(make_run, listed, content):
    run = make_run("100000-a", result("running", {}))
    (run / "metrics.jsonl").write_text(content, encoding="utf-8")
    assert listed()[0]["success"] is None


def test_an_interpolation_is_not_followed(make_run, listed):
    make_run("100000-a", result(), env="${oc.env:HOME}")
    assert listed()[0]["env"] == "${oc.env:HOME}"


def test_no_runs_are_no_error(listed):
    assert listed() == []


def test_an_unknown_status_is_refused():
    with pytest.raises(ConfigError, match="solved"):
        runs.main(["--status", "done"])


def test_runs_whose_environment_has_changed_are_told(
    make_run, tmp_path, caplog, capsys, monkeypatch
):
    monkeypatch.setattr(logging.getLogger("scilab_rl"), "propagate", True)
    for name in ("100000-a", "100001-b", "100002-c"):
        source = f'{{"fingerprint": "{name[-1:].replace("c", "b")}"}}'
        (make_run(name, result()) / "provenance.json").write_text(source, encoding="utf-8")
    runs.main(["--base-logdir", str(tmp_path / "data")])
    (warning,) = caplog.messages
    assert warning.startswith("FetchReach-v4 did not behave the same")
    assert len(read_table(capsys.readouterr().out)) == 3
    caplog.clear()
    runs.main(["--base-logdir", str(tmp_path / "data"), "--last", "2"])
    assert caplog.messages == []


def typed(run, *overrides):
    text = json.dumps({"overrides": overrides})
    (run / "provenance.json").write_text(text, encoding="utf-8")
    return run


def test_what_was_changed_is_shown_without_what_other_columns_show(make_run, listed):
    intrinsic = {"name": "sac", "intrinsic": {"name": "rnd", "weight": 0.5}}
    typed(
        make_run("100000-FetchReach-v4-sac-s7-0a1f", result(), algorithm=intrinsic),
        "algorithm=sac", "env=FetchReach", "seed=7", "++algorithm.gamma=0.9", "render=record",
        "algorithm.intrinsic=rnd", "algorithm.intrinsic.weight=0.5", "++tracking.x=false",
        "n_epochs=3",
    )  # fmt: skip
    (row,) = listed()
    assert row["id"] == "0a1f"
    assert row["changed"] == ["gamma=0.9", "intrinsic.weight=0.5", "n_epochs=3"]
    assert row["intrinsic"] == "rnd"


def test_the_runs_of_a_study_are_one_line(make_run, listed, tmp_path, capsys):
    study = tmp_path / "data" / "studies" / "wide"
    study.mkdir(parents=True)
    (study / "study.yaml").touch()
    make_run("100000-a", result())
    for index, success in enumerate((0.2, 0.8, 0.5)):
        make_run(f"11000{index}-b", result(metrics={"eval/success_rate": success}), group="wide")
    make_run("120000-c", result(), group="narrow")
    base = ["--base-logdir", str(tmp_path / "data")]
    runs.main(base)
    rows = read_table(capsys.readouterr().out)
    assert [row["run"] for row in rows] == ["100000-a", "wide", "120000-c"]
    assert (rows[1]["status"], rows[1]["success"]) == ("3 runs", "0.8")
    runs.main([*base, "--last", "2"])
    assert [row["run"] for row in read_table(capsys.readouterr().out)] == ["wide", "120000-c"]
    assert [row["study"] for row in listed()] == [None, "wide", "wide", "wide", None]
    assert len(listed("--study", "wide")) == 3
    runs.main([*base, "--unfold"])
    assert len(read_table(capsys.readouterr().out)) == 5


def test_notes_and_tags_are_shown_and_filter(make_run, listed):
    make_run("100000-a", result(), tags=["old"])
    write_annotations(make_run("110000-b", result()), "looks\nodd", ["new", "new", "x"])
    assert [(row["note"], row["tags"]) for row in listed()] == [
        ("", ["old"]),
        ("looks odd", ["new", "x"]),
    ]
    assert [row["run"] for row in listed("--tag", "x")] == ["110000-b"]


def test_eighty_columns_are_enough(make_run, tmp_path, monkeypatch, capsys):
    run = make_run("100000-FetchReach-v4-sac-s7-0a1f", result())
    typed(run, "n_epochs=3", "n_envs=2", "algorithm.gamma=0.9", "wrappers=[]", "on_nan=ignore")
    write_annotations(run, "the one with the shaking arm", ["thesis"])
    monkeypatch.setattr("scilab_rl.cli.runs.is_terminal", lambda: True)
    monkeypatch.setattr("scilab_rl.cli.tables.is_terminal", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    runs.main(["--base-logdir", str(tmp_path / "data")])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0].split()[:3] == ["id", "env", "algorithm"]
    assert {"changed", "status", "success", "note"} < set(lines[0].split())
    cell = "".join(line[lines[0].index("changed") : lines[0].index("status")] for line in lines[1:])
    assert "".join(cell.split()) == "gamma=0.9,n_epochs=3,n_envs=2,+2"
