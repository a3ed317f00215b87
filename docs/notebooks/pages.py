"""Notebooks as pages of the site, with the outputs that are stored in them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
# A hook of MkDocs, which calls `on_files`: it can import nothing else from here.
_LEFT_OUT = ("stderr",)  # progress and notices


@dataclass(frozen=True)
class Notebook:
    """One notebook.

    Attributes:
        path: Its file.
    """

    path: Path

    def cells(self) -> list[dict[str, Any]]:
        """Return its cells, as Jupyter stores them."""
        return json.loads(self.path.read_text(encoding="utf-8"))["cells"]

    def code(self) -> list[str]:
        """Return the code of each cell that has any."""
        return ["".join(c["source"]) for c in self.cells() if c["cell_type"] == "code"]

    def page(self) -> Iterator[str]:
        """Yield the lines of its page."""
        name = self.path.name
        for index, cell in enumerate(self.cells()):
            text = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                yield f"{text}\n"
                if index == 0:
                    yield f"[The notebook]({name}){{ download }}, to run and change it.\n"
                continue
            yield f"```python\n{text}\n```\n"
            for output in cell["outputs"]:
                yield from _shown(output)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the notebooks; called by MkDocs."""
    from mkdocs.structure.files import File

    for notebook in NOTEBOOKS:
        name = f"notebooks/{notebook.path.stem}.md"
        files.append(File.generated(config, name, content="\n".join(notebook.page())))
    return files


NOTEBOOKS = [Notebook(path) for path in sorted(FOLDER.glob("*.ipynb"))]


def _shown(output: dict[str, Any]) -> Iterator[str]:
    """Yield an output in its richest form."""
    if output.get("name") in _LEFT_OUT:
        return
    data = output.get("data", {})
    if "image/png" in data:
        yield f'<img alt="" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">\n'
    elif "text/html" in data:
        yield f'<div class="output">{_on_one_line("".join(data["text/html"]))}</div>\n'
    else:
        text = "".join(output.get("text") or data.get("text/plain", ""))
        yield f"```text\n{text.rstrip()}\n```\n"


def _on_one_line(html: str) -> str:
    """Return HTML without empty lines and indentation, which end or change it in Markdown.

    The style of pandas' tables is left out: the site has its own.
    """
    html = re.sub(r"<style scoped>.*?</style>", "", html, flags=re.DOTALL)
    html = html.replace('<table border="1" class="dataframe">', "<table>")
    return "".join(line.strip() + "\n" for line in html.splitlines() if line.strip()).rstrip()
