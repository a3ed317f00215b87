"""Report how the documentation reads: private words, long sentences, passive openings.

python -m docs.readability               the numbers of each page
python -m docs.readability --list        each finding, too
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Words that mean something only to people who wrote this project, or that sound translated.
PRIVATE = re.compile(
    r"\b(desks?|exams?|rehearsals?|ledgers?|campaigns?|beside|shall|foretell|foretold|thereof|whereof"
    r"|hopeless|retold|power cut|curious agents?|minds?|(?<!there )(?<!which )(?<!if )is no)\b",
    re.IGNORECASE,
)
LONG = 30  # words
_PASSIVE = re.compile(r"^(It|This|That|There|They|Each|All) (is|are|was|were|be|been) \w+ed\b")
_BLOCKS = re.compile(r"```.*?```|<!--.*?-->|`[^`]*`|\]\([^)]*\)", re.DOTALL)
_LINES = re.compile(r"^\s*[|#>!].*$", re.MULTILINE)


def pages() -> Iterator[tuple[str, str]]:
    """Yield the name and the prose of each page."""
    for path in sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]):
        yield path.relative_to(ROOT).as_posix(), _prose(path.read_text(encoding="utf-8"))


def docstrings() -> Iterator[tuple[str, str]]:
    """Yield the name of each module and the prose of its docstrings."""
    for path in sorted((ROOT / "src" / "scilab_rl").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        nodes = [node for node in ast.walk(tree) if isinstance(node, kinds)]
        texts = [text for node in nodes if (text := ast.get_docstring(node))]
        yield path.relative_to(ROOT).as_posix(), "\n\n".join(map(_prose, texts))


def findings(prose: str) -> dict[str, list[str]]:
    """Return the findings in a text by their kind."""
    sentences = [
        " ".join(s.split()) for s in re.split(r"(?<=[.!?:])\s+|\n\s*\n|\n\s*[*\-]\s", prose)
    ]
    return {
        "private words": [m[0] for m in PRIVATE.finditer(prose)],
        "long sentences": [s for s in sentences if len(s.split()) > LONG],
        "passive openings": [s for s in sentences if _PASSIVE.match(s)],
    }


def main() -> None:
    """Print the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="print each finding")
    parser.add_argument(
        "--docstrings", action="store_true", help="of the code instead of the pages"
    )
    options = parser.parse_args()
    total: dict[str, int] = {}
    for name, prose in docstrings() if options.docstrings else pages():
        found = findings(prose)
        for kind, items in found.items():
            total[kind] = total.get(kind, 0) + len(items)
            if options.list:
                for item in items:
                    sys.stdout.write(f"{name}: {kind[:-1]}: {item}\n")
    numbers = (f"{kind}: {number}" for kind, number in total.items())
    sys.stdout.write(", ".join(numbers) + "\n")


def _prose(text: str) -> str:
    return _LINES.sub("", _BLOCKS.sub(" ", text))


if __name__ == "__main__":
    main()
