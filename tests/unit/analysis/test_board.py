"""What the board shows of runs, and the server that keeps it up to date."""

from __future__ import annotations

import base64
import json
import threading
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from scilab_rl.analysis.board import BoardReader, write_board
from scilab_rl.cli.board import BoardServer
from scilab_rl.run.directory import RunDirectory

ALGORITHM = {"name": "sac", "_target_": "x.SAC", "gamma": 0.9}


def make_run(
    base: Path, name: str, values: list[float | None], status: str = "finished", **config: object
) -> Path:
    path = base / "2026-01-02" / name
    (path / "episodes").mkdir(parents=True)
    settings = {"env": "E-v0", "algorithm": ALGORITHM, "seed": 1, **config}
    (path / "config.yaml").write_text(json.dumps(settings))
    rows = [
        {"kind": "epoch", "epoch": i + 1, "step": 10 * (i + 1), "eval/success_rate": value}
        for i, value in enumerate(values)
    ]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    last = {"eval/success_rate": values[-1], "eval/mean_reward": -1.0}
    result = {"status": status, "score": None, "epochs": 2, "steps": 20, "seconds": 5.0}
    (path / "result.json").write_text(json.dumps({**result, "run_dir": "", "metrics": last}))
    return path


@pytest.fixture
def base(tmp_path: Path) -> Path:
    base = tmp_path / "data"
    make_run(base, "100000-E-sac-s1-0001", [0.0, 0.5])
    make_run(base, "100001-E-sac-s2-0002", [0.25, None, 1.0], seed=2)
    changed = {**ALGORITHM, "gamma": 0.5}
    path = make_run(base, "100002-E-sac-s1-0003", [0.5, 0.5], algorithm=changed)
    for page in ("episodes/a", "episodes/episodes", "goals/goals", "whatif/a_goal"):
        (path / page).parent.mkdir(exist_ok=True)
        (path / f"{page}.html").touch()
    (path / "curve.png").touch()
    return base


def decode(board: dict, name: str) -> list[list[float]]:
    """Decode curves as the page does."""
    stored, at, curves = board["metrics"][name], 0, []
    numbers = np.frombuffer(base64.b64decode(stored["data"]), "<u2").astype(float)
    for run, (low, high) in zip(stored["runs"], stored["ranges"], strict=True):
        n = len(board["steps"][run])
        values = low + (high - low) * numbers[at : at + n] / 65534
        curves.append([round(v, 4) for v, raw in zip(values, numbers[at : at + n], strict=True)
                       if raw != 65535])  # fmt: skip
        at += n
    return curves


def test_repeats_are_one_group_and_say_what_is_different(base: Path) -> None:
    board = BoardReader(base).read()
    groups = [(group["runs"], group["label"]) for group in board["groups"]]
    assert groups == [([0, 1], []), ([2], ["gamma=0.5"])]
    assert board["runs"]["id"] == ["0001", "0002", "0003"]
    assert board["runs"]["links"][2] == [
        (name, f"2026-01-02/100002-E-sac-s1-0003/{address}")
        for name, address in (
            ("goals", "goals/goals.html"),
            ("whatif a_goal", "whatif/a_goal.html"),
            ("episodes", "episodes/episodes.html"),
            ("replay a", "episodes/a.html"),
            ("curve", "curve.png"),
            ("files", ""),
        )
    ]


def test_curves_come_back_with_their_gaps(base: Path) -> None:
    board = BoardReader(base).read()
    assert board["steps"] == [[10, 20], [10, 20, 30], [10, 20]]
    assert decode(board, "eval/success_rate") == [[0.0, 0.5], [0.25, 1.0], [0.5, 0.5]]


def test_long_curves_are_thinned_and_keep_their_last_value(tmp_path: Path) -> None:
    make_run(tmp_path, "100000-a", [i / 1000 for i in range(1001)])
    board = BoardReader(tmp_path).read()
    assert board["thinned"]
    assert (len(board["steps"][0]), board["steps"][0][-1]) == (200, 10010)
    assert decode(board, "eval/success_rate")[0][-1] == 1.0


def test_damaged_runs_and_none_at_all(tmp_path: Path) -> None:
    assert BoardReader(tmp_path).read()["runs"]["run"] == []
    for name, text in (("a", "env: [unclosed"), ("b", "just a text"), ("c", "")):
        (make_run(tmp_path, f"100000-{name}", [0.5]) / "config.yaml").write_text(text)
    (tmp_path / "2026-01-02" / "100000-c" / "metrics.jsonl").write_bytes(b"\xff\xfe\x00")
    board = BoardReader(tmp_path).read()
    assert board["runs"]["status"] == ["damaged"] * 3


def test_links_lead_to_the_runs_from_wherever_the_page_is(base: Path) -> None:
    page = write_board(base, base.parent / "pages" / "all.html").read_text()
    assert '"root": "../data/"' in page
    assert '"root": ""' in write_board(base).read_text()


def test_names_that_are_code_do_not_become_code(tmp_path: Path) -> None:
    make_run(tmp_path, "100000-a", [0.5], env="</script><script>alert(1)</script>")
    page = write_board(tmp_path).read_text()
    assert "alert(1)" in page
    assert "<script>alert(1)" not in page


def test_only_changed_runs_are_read_again(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader, read = BoardReader(base), []
    before = reader.version()
    reader.read()
    from scilab_rl.analysis import board as module

    original = module._read
    monkeypatch.setattr(
        module, "_read", lambda run, *rest: read.append(run.id) or original(run, *rest)
    )
    make_run(base, "100003-E-sac-s3-0004", [0.1], seed=3)
    with (base / "2026-01-02/100000-E-sac-s1-0001/metrics.jsonl").open("a") as file:
        file.write('{"kind": "epoch", "epoch": 3, "step": 30, "eval/success_rate": 0.75}\n')
    assert reader.version() != before
    board = reader.read()
    assert read == ["0001", "0004"]
    assert decode(board, "eval/success_rate")[0] == [0.0, 0.5, 0.75]


def test_a_run_that_dies_is_noticed_although_no_file_changes(tmp_path: Path) -> None:
    run = RunDirectory(make_run(tmp_path, "100000-a", [0.5], "running"))
    reader = BoardReader(tmp_path)
    with run.in_use():
        assert reader.read()["runs"]["status"] == ["running"]
        reader.read()
        alive = reader.version()
        assert reader.version() == alive
    assert reader.version() != alive
    assert reader.read()["runs"]["status"] == ["crashed"]


def test_the_server_answers_this_machine_only(base: Path) -> None:
    with BoardServer(base, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            page = urllib.request.urlopen(server.address).read().decode()
            assert "const WATCHES = true" in page
            with urllib.request.urlopen(server.address + "board.json") as answer:
                assert len(json.load(answer)["groups"]) == 2
            with urllib.request.urlopen(server.address + "version?x") as answer:
                assert answer.read().decode() == server.reader.version()
            file = server.address + "2026-01-02/100000-E-sac-s1-0001/result.json"
            with urllib.request.urlopen(file) as answer:
                assert json.load(answer)["status"] == "finished"
            foreign = urllib.request.Request(server.address, headers={"Host": "evil.example:80"})
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(foreign)
            outside = urllib.request.Request(server.address + "..%2f..%2fetc/passwd")
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(outside)
        finally:
            server.shutdown()
            thread.join()
