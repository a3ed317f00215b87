"""Every package that is imported is declared, and those of extras are imported late."""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "scilab_rl"
# Import names that are not the distribution's, also where it is not installed.
DISTRIBUTIONS = {
    "markdown_it": "markdown-it-py",
    "PIL": "pillow", "yaml": "pyyaml", "hydra": "hydra-core", "rerun": "rerun-sdk",
    "stable_baselines3": "stable-baselines3", "zmq": "pyzmq", "highway_env": "highway-env",
}  # fmt: skip
MODELS = (
    "hybrid", "kalmanthompson", "kalmanucb", "randomchoice", "rescorlawagner", "rescorlawagner2",
    "rescorlawagnersticky", "winstayloseshift",
)  # fmt: skip
# Modules that are imported only where their package is known to be installed, or for its users.
BEHIND_AN_EXTRA = {
    "learning/jax_engine.py", "learning/jax_off_policy.py",
    "algorithms/jaxcrl.py", "algorithms/jaxgciql.py",
    "algorithms/jaxsac.py", "algorithms/jaxtd3.py", "learning/cognitive.py",
    *(f"algorithms/models/{name}.py" for name in MODELS),
    *(f"analysis/fitting/{name}.py" for name in ("estimation", "hierarchical", "selection")),
    "analysis/fitting/inference_data.py", "analysis/fitting/simulation.py",
    "envs/suites/highway_env.py", "envs/suites/metaworld.py", "envs/suites/panda_gym.py",
    "testing/algorithms.py", "testing/models.py",
}  # fmt: skip


def declared() -> tuple[set[str], set[str]]:
    """Return the distributions of the core, and those of all extras."""
    tomllib = pytest.importorskip("tomllib")  # from Python 3.11 on
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    core = {name_of(word) for word in project["dependencies"]}
    for extra in [e for word in project["dependencies"] for e in extras_of(word)]:
        core |= {name_of(word) for word in extras[extra]}
    return core, core | {name_of(word) for words in extras.values() for word in words}


def name_of(requirement: str) -> str:
    return re.split(r"[\s\[<>=!;~]", requirement, maxsplit=1)[0].lower().replace("_", "-")


def extras_of(requirement: str) -> list[str]:
    found = re.match(r"scilab-rl\[(.*)\]", requirement)
    return found[1].split(",") if found else []


class Imports(ast.NodeVisitor):
    """Collects the packages that a module imports, and whether it does so when it is imported."""

    def __init__(self) -> None:
        self.found: dict[str, bool] = defaultdict(bool)
        self._is_late = 0

    def visit_FunctionDef(self, node: ast.AST) -> None:
        self._is_late += 1
        self.generic_visit(node)
        self._is_late -= 1

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_If(self, node: ast.If) -> None:
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return
        self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self._note(alias.name)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        self._note(node.module or "")

    def _note(self, module: str) -> None:
        self.found[module.partition(".")[0]] |= not self._is_late


def third_party(path: Path) -> dict[str, bool]:
    """Return the distributions that a file imports, and which of them at its top."""
    visitor = Imports()
    visitor.visit(ast.parse(path.read_text(encoding="utf-8")))
    ours = {
        "scilab_rl",
        "hydra_plugins",
        "custom_envs",
        "custom_algorithms",
        *sys.stdlib_module_names,
    }
    return {
        DISTRIBUTIONS.get(name, name.lower().replace("_", "-")): at_top
        for name, at_top in visitor.found.items()
        if name not in ours
    }


FILES = sorted(path for path in (ROOT / "src").rglob("*.py"))


def test_every_import_is_declared() -> None:
    _, everything = declared()
    missing = {(name, path.name) for path in FILES for name in third_party(path)} - {
        (name, path.name) for path in FILES for name in everything
    }
    assert not missing


def test_packages_of_extras_are_imported_late() -> None:
    core, _ = declared()
    early = {
        (name, path.relative_to(PACKAGE).as_posix())
        for path in PACKAGE.rglob("*.py")
        for name, at_top in third_party(path).items()
        if at_top and name not in core
    }
    assert {path for _, path in early} == BEHIND_AN_EXTRA


def test_the_names_of_distributions_are_right() -> None:
    by_module = metadata.packages_distributions()
    for module, distribution in DISTRIBUTIONS.items():
        if module in by_module:
            assert distribution in {name_of(name) for name in by_module[module]}
