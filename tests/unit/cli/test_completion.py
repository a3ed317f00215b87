"""What the Tab key offers."""

import subprocess

import pytest

from scilab_rl.cli import completion
from scilab_rl.cli.completion import candidates
from scilab_rl.results import RunResult


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("scilab-rl pl", ["play", "plot"]),
        ("scilab-rl render=re", ["render=record"]),
        ("scilab-rl algorithm=cleans", ["algorithm=cleansac", "algorithm=cleansacmc"]),
        ("scilab-rl env=FetchRea", ["env=FetchReach", "env=FetchReachDense"]),
        ("scilab-rl n_ep", ["n_epochs="]),
        ("scilab-rl env=FetchReach n_ep", ["n_epochs="]),
        ("scilab-rl runs --ta", ["--tag"]),
        ("scilab-rl delete --", ["--base-logdir", "--help", "--mlflow", "--yes"]),
        ("scilab-rl play agent:Fetch", [
            "agent:FetchPickAndPlace", "agent:FetchPush", "agent:FetchReach", "agent:FetchSlide",
        ]),
        ("scilab-rl experiment base=cleanp", ["base=cleanppo"]),
        ("scilab-rl note 'open", []),
        ("scilab-rl nothing=", []),
    ],
)  # fmt: skip
def test_words_are_completed(project, line, expected):
    assert candidates(line) == expected


def test_runs_are_completed_by_their_ids(project, make_run):
    make_run("100000-E-sac-s7-0a1f", RunResult("finished", 0.9, 3, 6000, 60.0, ""))
    assert candidates("scilab-rl play 0") == ["0a1f"]
    assert {"last", "0a1f"} < set(candidates("scilab-rl plot "))


def test_bash_completes_behind_an_equals_sign(project, tmp_path, capsys):
    """The real shell: it has cut the word at the sign and wants only what follows."""
    completion.main(["bash"])
    script = capsys.readouterr().out
    assert completion.main(["zsh"]) == 0
    body = f"""
        scilab-rl() {{ printf 'algorithm=cleansac\\nalgorithm=cleansacmc\\n'; }}
        {script}
        COMP_LINE='scilab-rl algorithm=cl'; COMP_POINT=${{#COMP_LINE}}
        _scilab_rl; echo "${{COMPREPLY[@]}}"
        scilab-rl() {{ printf 'n_epochs=\\n'; }}
        compopt() {{ echo "$@"; }}
        COMP_LINE='scilab-rl n_e and more'; COMP_POINT=13
        _scilab_rl; echo "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "-c", body], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["cleansac cleansacmc", "-o nospace", "n_epochs="]
