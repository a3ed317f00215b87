"""Notes, tags, and the removal of runs."""

import io
import logging

import pytest

from scilab_rl.analysis.groups import read_record
from scilab_rl.cli import clean, delete, note, tag
from scilab_rl.errors import ConfigError
from scilab_rl.results import RunResult
from scilab_rl.run.annotations import ANNOTATIONS_FILE, Annotations, read_annotations
from scilab_rl.run.directory import all_runs, find_run

DONE = RunResult("finished", 0.9, 3, 6000, 60.0, "")


@pytest.fixture
def two(project, make_run):
    """Two runs, with ids."""
    return [make_run(f"10000{i}-E-sac-s7-000{i}", DONE) for i in range(2)]


def test_a_note_is_written_shown_replaced_and_removed(two, capsys):
    note.main(["0000", "the", "arm shakes"])
    note.main(["0000"])
    assert capsys.readouterr().out == "the arm shakes\n"
    note.main(["0000", "fixed\nnow"])
    assert read_annotations(two[0]) == Annotations("fixed now")
    note.main(["0000", ""])
    assert not (two[0] / ANNOTATIONS_FILE).exists()


def test_tags_are_added_and_removed_and_keep_the_note(two, capsys):
    note.main(["0001", "n"])
    tag.main(["0001", "thesis", "figure-3"])
    tag.main(["0001", "thesis", "good"])
    tag.main(["0001", "--remove", "figure-3"])
    tag.main(["0001"])
    assert capsys.readouterr().out == "thesis good\n"
    assert read_annotations(two[1]) == Annotations("n", ("thesis", "good"))


@pytest.mark.parametrize("word", ["two words", "a,b", "x=1", "a*", ""])
def test_a_tag_is_a_word(two, word):
    with pytest.raises(ConfigError, match="one word"):
        tag.main(["0000", word])


def test_a_tag_that_is_not_there_cannot_be_removed(two):
    tag.main(["0000", "here"])
    with pytest.raises(ConfigError, match=r"no tag 'there' to remove. It has: here"):
        tag.main(["0000", "--remove", "there"])


@pytest.mark.parametrize("text", ["", "[]", "3", '{"note": 1}', '{"note": "", "tags": 3}'])
def test_damaged_annotations_are_none(two, text):
    (two[0] / ANNOTATIONS_FILE).write_text(text)
    assert read_annotations(two[0]) == Annotations()


def test_comparisons_find_a_run_by_a_tag_given_later(make_run):
    run = make_run("100000-a", DONE, n_epochs=3, eval_after_n_steps=2000, tags=["first"])
    tag.main([str(run), "later"])
    assert read_record(run).tags == ("first", "later")


def answer(monkeypatch, text):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr("sys.stdin", Terminal(text))


def test_delete_asks(two, monkeypatch, capsys):
    answer(monkeypatch, "\n")
    assert delete.main(["0000"]) == 1
    assert two[0].path.is_dir()
    assert "Remove this run? [y/N]" in capsys.readouterr().err
    answer(monkeypatch, "y\n")
    assert delete.main(["0000", "100000-E-sac-s7-0000"]) == 0
    assert [run.id for run in all_runs(two[1].path.parents[1])] == ["0001"]


def test_without_a_terminal_the_answer_is_on_the_command_line(two, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    with pytest.raises(ConfigError, match="--yes"):
        delete.main(["0000"])
    assert delete.main(["0000", "--yes"]) == 0
    assert not two[0].path.exists()


def test_last_points_to_the_newest_that_is_left(two):
    base = two[0].path.parents[1]
    two[1].publish_as_last(base)
    delete.main(["last", "--yes"])
    assert find_run("last", base).id == "0000"
    delete.main(["last", "--yes"])
    assert list(base.iterdir()) == []


def test_a_run_that_trains_and_an_agent_are_kept(two):
    with two[0].in_use(), pytest.raises(ConfigError, match="stop it first"):
        delete.main(["0001", "0000", "--yes"])
    assert two[1].path.is_dir()
    with pytest.raises(ConfigError, match="is a trained agent"):
        delete.main(["agent:CartPole", "--yes"])


def test_a_removal_that_was_killed_is_not_a_run_and_clean_finds_it(two):
    base = two[0].path.parents[1]
    half = two[0].path.with_name(f".{two[0].path.name}.7.tmp")
    two[0].path.rename(half)
    assert [run.id for run in all_runs(base)] == ["0001"]
    assert dict(clean.leftovers(base)) == {half: "half removed run"}


def test_mlflow_forgets_the_run_too(two, monkeypatch, caplog):
    pytest.importorskip("mlflow")
    monkeypatch.setattr(logging.getLogger("scilab_rl"), "propagate", True)
    asked = []
    monkeypatch.setattr(
        "scilab_rl.tracking.mlflow.MLflowTracker.delete",
        lambda self, run: asked.append((run.name, str(run.base_logdir))) or len(asked) == 1,
    )
    caplog.set_level(logging.INFO)
    delete.main(["0000", "0001", "--yes", "--mlflow"])
    assert asked == [("100000-E-sac-s7-0000", "data"), ("100001-E-sac-s7-0001", "data")]
    assert "MLflow does not know 100001-E-sac-s7-0001." in caplog.messages
