"""The notebooks run, and hold the outputs of the code that they hold."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import gymnasium
import pytest
from docs.notebooks.pages import NOTEBOOKS, Notebook

# What makes a notebook take minutes, and what takes its place here.
SHORTER = (
    (r'"n_epochs": 4, "eval_after_n_steps": 250',
     '"n_epochs": 1, "eval_after_n_steps": 60, "n_test_rollouts": 2'),
    (r'"algorithm.net_arch": \[64, 64\], "algorithm.learning_starts": 100',
     '"algorithm.net_arch": [8], "algorithm.learning_starts": 20'),
    (r"episodes=\d+", "episodes=2"),
    (r"\(2, 3\)|\(1, 2, 3\)", "(2,)"),
)  # fmt: skip
# What needs seconds for itself and is tested elsewhere.
ELSEWHERE = ("run.replay()", "agent.export(")


@pytest.fixture(params=NOTEBOOKS, ids=lambda notebook: notebook.path.stem)
def notebook(request: pytest.FixtureRequest) -> Notebook:
    return request.param


def execute(notebook: Notebook, shorter: bool) -> None:
    """Run the cells one after the other, each to the text of its last line."""
    names: dict[str, object] = {"__name__": "notebook"}
    for index, code in enumerate(notebook.code()):
        if shorter:
            if any(word in code for word in ELSEWHERE):
                continue
            for pattern, instead in SHORTER:
                code = re.sub(pattern, instead, code)
        tree = ast.parse(code)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"cell {index}", "exec"), names)
        if last is not None:
            shown = eval(compile(ast.Expression(last.value), f"cell {index}", "eval"), names)
            assert repr(shown)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    gymnasium.registry.pop("Line-v0", None)


def test_notebooks_run(notebook: Notebook, folder: Path) -> None:
    pytest.importorskip("pandas")
    changed = "".join(notebook.code())
    assert all(re.search(pattern, changed) for pattern, _ in SHORTER)
    execute(notebook, shorter=True)
    assert (folder / "steps.csv").is_file()


@pytest.mark.slow
def test_notebooks_run_as_they_are(notebook: Notebook, folder: Path) -> None:
    pytest.importorskip("pandas")
    execute(notebook, shorter=False)
    assert (folder / "robot" / "policy.npz").is_file()


def test_outputs_are_those_of_one_run_from_top_to_bottom(notebook: Notebook) -> None:
    cells = [cell for cell in notebook.cells() if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert outputs and all(output["output_type"] != "error" for output in outputs)
    assert not re.search(r"/(tmp|home|work|root)/", notebook.path.read_text(encoding="utf-8"))


def test_the_page_shows_code_and_outputs(notebook: Notebook) -> None:
    page = "\n".join(notebook.page())
    assert all(f"```python\n{code}\n```" in page for code in notebook.code())
    assert '<img alt="" src="data:image/png;base64,' in page and "<iframe srcdoc=" in page
    assert "<style scoped>" not in page
