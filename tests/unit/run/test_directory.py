import datetime as dt
import json
import multiprocessing
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest

from scilab_rl.errors import ConfigError
from scilab_rl.results import RunResult
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory, all_runs, find_run, read_epochs, slug

HOSTILE = [
    "../x",
    "../../etc/passwd",
    "/etc/x",
    "a/../../b",
    "~",
    "~root",
    ".",
    "..",
    "",
    " ",
    "nul\0byte",
    "new\nline",
    "%2e%2e%2f",
    "x" * 300,
    "CON",
    "\u202egnp.exe",
    "-rf",
    "$(touch x)",
    "`id`",
    "a'b\"c",
    "a;b|c&d",
    "C:\\x",
    "ümlaut",
    "{a,b}*?",
]


def make_run(base, env="TinyReach-v0", seed=1):
    run = RunDirectory.create(base, env, "sac", seed)
    (run / CONFIG_FILE).write_text("env: x\n")
    return run


class Noon:
    """A clock that stands still."""

    @staticmethod
    def now():
        return dt.datetime(2026, 1, 2, 12)


@pytest.fixture
def noon(monkeypatch):
    monkeypatch.setattr("scilab_rl.run.directory.dt", SimpleNamespace(datetime=Noon))


def create(base, results):
    results.put(str(RunDirectory.create(base, "FetchReach-v4", "sac", 1).path))


@pytest.mark.filterwarnings(
    "ignore:.*multi-threaded.*:DeprecationWarning"
)  # it only makes a folder
def test_fifty_processes_in_the_same_second_get_fifty_directories(tmp_path, noon):
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    processes = [context.Process(target=create, args=(tmp_path, results)) for _ in range(50)]
    for process in processes:
        process.start()
    paths = [Path(results.get(timeout=30)) for _ in processes]
    for process in processes:
        process.join()
    assert len(set(paths)) == 50
    assert all(path.is_dir() for path in paths)
    assert {path.name[:-4] for path in paths} == {"120000-FetchReach-v4-sac-s1-"}


def test_a_taken_name_is_never_taken_again(tmp_path, monkeypatch, noon):
    suffixes = iter(["aaaa", "aaaa", "aaaa", "bbbb"])
    monkeypatch.setattr("scilab_rl.run.directory.secrets.token_hex", lambda _: next(suffixes))
    first = RunDirectory.create(tmp_path, "E", "sac", 1)
    (first / "treasure").touch()
    second = RunDirectory.create(tmp_path, "E", "sac", 1)
    assert (first.path.name, second.path.name) == ("120000-E-sac-s1-aaaa", "120000-E-sac-s1-bbbb")
    assert (first / "treasure").exists()


@pytest.mark.parametrize("name", HOSTILE)
def test_no_name_leads_out_of_the_base(tmp_path, name):
    base = tmp_path / "data"
    run = RunDirectory.create(base, name, name, 1)
    assert run.path.parent.parent == base
    assert run.path.resolve().is_relative_to(base.resolve())
    assert len(run.path.name) < 255
    assert {path.name for path in tmp_path.iterdir()} == {"data"}


@pytest.mark.parametrize("name", HOSTILE)
def test_slugs_are_plain_words(name):
    plain = slug(name)
    assert plain
    assert plain.isascii()
    assert all(character.isalnum() or character in "._-" for character in plain)
    assert plain[0] not in ".-"
    assert len(plain) <= 80


def test_different_environments_keep_readable_names():
    assert slug("ALE/Pong-v5") == "ALE_Pong-v5"
    assert slug("scilab_rl.testing:TinyReach-v0") == "scilab_rl.testing_TinyReach-v0"


def test_a_folder_that_cannot_be_written_is_one_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="file"):
        RunDirectory.create(tmp_path / "file" / "data", "E", "sac", 1)


def test_results_come_back_as_they_were(tmp_path):
    run = make_run(tmp_path)
    assert run.read_result() is None
    result = RunResult("finished", 0.5, 2, 20, 3.0, str(run), {"eval/success_rate": 0.5})
    run.write_result(result)
    assert run.read_result() == result


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"status": "finished"}', '{"foreign": 1}']
)
def test_a_damaged_result_is_none(tmp_path, text):
    run = make_run(tmp_path)
    (run / "result.json").write_text(text)
    assert run.read_result() is None


@pytest.mark.parametrize(
    ("number", "scheduler", "expected"),
    [
        (0, False, 0),
        (signal.SIGINT, False, 130),
        (signal.SIGTERM, False, 143),
        (signal.SIGTERM, True, 75),
    ],
)
def test_the_exit_code_says_what_interrupted(monkeypatch, number, scheduler, expected):
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    if scheduler:
        monkeypatch.setenv("SLURM_JOB_ID", "1")
    result = RunResult("interrupted", None, 0, 0, 0.0, "x", signal_number=int(number))
    assert result.exit_code == expected


def test_a_discarded_run_leaves_nothing_but_other_runs(tmp_path):
    base = tmp_path / "data"
    kept, refused = make_run(base), make_run(base)
    refused.discard()
    assert [run.path for run in all_runs(base)] == [kept.path]
    kept.discard()
    assert not base.exists()


def test_runs_are_found_by_last_path_part_and_policy(tmp_path):
    one, two = make_run(tmp_path, "FetchReach-v4"), make_run(tmp_path, "FetchPush-v4", seed=2)
    two.publish_as_last(tmp_path)
    (one / "rl_model_best").mkdir()
    for name, expected in [
        ("last", two),
        (str(one), one),
        (str(one / "rl_model_best"), one),
        (f"{one.path.parent.name}/{one.path.name}", one),
        (one.path.name, one),
        ("FetchPush", two),
        ("-s2-", two),
    ]:
        assert find_run(name, tmp_path).path == expected.path.resolve()


def test_a_name_that_fits_several_runs_or_none_says_what_to_do(tmp_path):
    make_run(tmp_path, "FetchReach-v4")
    other = make_run(tmp_path, "FetchReach-v4")
    with pytest.raises(ConfigError, match=r"fits 2 runs in .*; give the id of one, or more"):
        find_run("FetchReach", tmp_path)
    with pytest.raises(ConfigError, match=f"Did you mean '{other.path.name}'"):
        find_run(other.path.name[:-1] + "?", tmp_path)
    with pytest.raises(ConfigError, match="No run"):
        find_run("", tmp_path)


def test_an_id_names_one_run_even_if_other_names_contain_it(tmp_path):
    for name in ("120000-E-sac-s1-3412", "341200-E-sac-s1-beef", "120000-E-sac-s3412-cafe"):
        (tmp_path / "2026-01-02" / name).mkdir(parents=True)
        (tmp_path / "2026-01-02" / name / CONFIG_FILE).write_text("env: x\n")
    assert find_run("3412", tmp_path).path.name == "120000-E-sac-s1-3412"
    assert [run.id for run in all_runs(tmp_path)] == ["3412", "cafe", "beef"]


def test_a_new_run_gets_an_id_that_no_run_has(tmp_path, monkeypatch):
    drawn = iter(["aaaa", "aaaa", "aaaa", "bbbb"])
    monkeypatch.setattr("scilab_rl.run.directory.secrets.token_hex", lambda _: next(drawn))
    assert make_run(tmp_path, "E").id == "aaaa"
    assert make_run(tmp_path, "Other").id == "bbbb"


def test_the_link_to_the_last_run_is_not_listed_as_another_run(tmp_path):
    run = make_run(tmp_path)
    run.publish_as_last(tmp_path)
    assert [found.path for found in all_runs(tmp_path)] == [run.path]
    assert (tmp_path / "last").readlink() == run.path.relative_to(tmp_path)


def test_epochs_are_read_up_to_a_cut_line(tmp_path):
    run = make_run(tmp_path)
    assert read_epochs(run) == []
    rows = [
        {"kind": "episode", "step": 1},
        {"kind": "epoch", "step": 2},
        {"kind": "epoch", "step": 4},
    ]
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (run / "metrics.jsonl").write_text(text[:-5])
    assert read_epochs(run) == [{"kind": "epoch", "step": 2}]
