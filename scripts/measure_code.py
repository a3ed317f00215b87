"""Measure the size and shape of the package: lines, modules, `Any`, functions, duplicates.

Figures of single revisions do not say whether code is good; those of two say where it went.

Run: python scripts/measure_code.py [REVISION ...]        (without one: the working tree)
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

_ROOT = Path(__file__).parents[1]
_PACKAGE = "src/scilab_rl"
_BLOCK = 6  # lines that make a duplicate worth counting
_Function = ast.FunctionDef | ast.AsyncFunctionDef


def main(revisions: list[str]) -> None:
    """Print one column per revision."""
    measured = [measure(read_sources(revision)) for revision in revisions or [""]]
    rows = list(dict.fromkeys(row for figures in measured for row in figures))
    table = [["", *(revisions or ["now"])], ["---"] * (len(measured) + 1)]
    table += [[row, *(f"{figures.get(row, 0):,}" for figures in measured)] for row in rows]
    for cells in table:
        print(f"| {' | '.join(cells)} |")  # noqa: T201


def read_sources(revision: str) -> dict[str, str]:
    """Return the source of each module of the package by its path inside it.

    Args:
        revision: A commit; empty means the working tree.
    """
    if not revision:
        package = _ROOT / _PACKAGE
        return {
            path.relative_to(package).as_posix(): path.read_text(encoding="utf-8")
            for path in sorted(package.rglob("*.py"))
        }
    listed = _git("ls-tree", "-r", "--name-only", revision, _PACKAGE).splitlines()
    paths = [path for path in listed if path.endswith(".py")]
    return {path.removeprefix(f"{_PACKAGE}/"): _git("show", f"{revision}:{path}") for path in paths}


def measure(sources: Mapping[str, str]) -> dict[str, int]:
    r"""Return the figures of a package.

    Args:
        sources: The source of each module by its path inside the package.

    >>> figures = measure({"a.py": "def _half(x):\n    return x / 2\n\nprint(_half(4))\n"})
    >>> figures["lines"], figures["modules"], figures["top-level functions used once"]
    (4, 1, 1)
    """
    packages: Counter[str] = Counter()
    for path, source in sources.items():
        package, separator, _ = path.partition("/")
        packages[package if separator else "(top level)"] += len(source.splitlines())
    trees = {path: ast.parse(source) for path, source in sources.items()}
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    lengths = [
        (node.end_lineno or node.lineno) - node.lineno + 1
        for node in nodes
        if isinstance(node, _Function)
    ]
    top_level = [n for tree in trees.values() for n in tree.body if isinstance(n, _Function)]
    text = "\n".join(sources.values())
    words = Counter(re.findall(r"\w+", text))
    figures = {
        "lines": packages.total(),
        **{f"lines of {package}": packages[package] for package in sorted(packages)},
        "modules": len(sources),
        "`Any`": sum(bool(re.search(r"\bAny\b", line)) for line in text.splitlines()),
        "top-level functions": len(top_level),
        "top-level functions used once": sum(words[node.name] == 2 for node in top_level),
        f"duplicates of {_BLOCK} lines or more": count_duplicates(sources),
        "files that import omegaconf": sum(map(_imports_omegaconf, trees.values())),
    }
    for name, share in (("median", 50), ("p90", 90), ("longest", 100)):
        figures[f"lines of a function: {name}"] = round(float(np.percentile(lengths, share)))
    return figures


def count_duplicates(sources: Mapping[str, str]) -> int:
    """Return how many blocks of six or more lines of code stand in the package a second time.

    Lines are compared without indentation; imports, docstrings, comments and lines of punctuation
    only are left out.
    """
    seen: set[tuple[str, ...]] = set()
    n_duplicates = 0
    for source in sources.values():
        lines = list(_code_lines(source))
        inside = False
        for start in range(len(lines) - _BLOCK + 1):
            block = tuple(lines[start : start + _BLOCK])
            n_duplicates += block in seen and not inside
            inside = block in seen
            seen.add(block)
    return n_duplicates


def _code_lines(source: str) -> Iterator[str]:
    hidden: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_text or isinstance(node, (ast.Import, ast.ImportFrom)):
            hidden.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    for number, line in enumerate(source.splitlines(), start=1):
        if number not in hidden and re.search(r"\w", line.partition("#")[0]):
            yield line.strip()


def _imports_omegaconf(tree: ast.AST) -> bool:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import) and any(n.name == "omegaconf" for n in node.names):
            return True
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("omegaconf"):
            return True
    return False


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments], cwd=_ROOT, capture_output=True, text=True, check=True
    ).stdout


if __name__ == "__main__":
    main(sys.argv[1:])
