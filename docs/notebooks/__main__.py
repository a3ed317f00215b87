"""Run the notebooks in Jupyter's kernel and keep their outputs: needs ``pip install nbclient``."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

from docs.notebooks.pages import NOTEBOOKS, Notebook


def run(notebook: Notebook) -> None:
    """Run all cells in an empty folder and write the notebook with its outputs."""
    import nbformat
    from nbclient import NotebookClient

    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            loaded = nbformat.read(notebook.path, as_version=4)
            NotebookClient(loaded, timeout=1200).execute()
        finally:
            os.chdir(before)
    for cell in loaded.cells:
        cell.metadata.pop("execution", None)  # when it ran, and how long
    text = json.dumps(loaded, indent=1, ensure_ascii=False)
    notebook.path.write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    for notebook in NOTEBOOKS:
        run(notebook)
