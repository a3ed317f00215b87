"""An installation without extras, for all tests of this folder."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import pytest

from tests.unit.test_dependencies import declared

# Makes everything look as if it were not installed that the core's dependencies do not bring.
SITE = """
import importlib.machinery, sys
from pathlib import Path

ALLOWED = set(Path(__file__).with_name("allowed.txt").read_text().split())


class CoreAlone(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        spec = super().find_spec(name, path, target)
        if path is not None or spec is None or name in ALLOWED:
            return spec
        places = [spec.origin or "", *(spec.submodule_search_locations or ())]
        return None if any("site-packages" in place for place in places) else spec


at = sys.meta_path.index(importlib.machinery.PathFinder)
sys.meta_path[at] = CoreAlone
"""


def with_requirements(names: Iterable[str]) -> set[str]:
    """Return these distributions and all that they need themselves."""
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop().lower().replace("_", "-")
        if name in found or name == "scilab-rl":
            continue
        found.add(name)
        try:
            requirements = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        waiting += [re.split(r"[\s\[<>=!;~(]", r)[0] for r in requirements if "extra ==" not in r]
    return found


@pytest.fixture(scope="session")
def core_alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for PYTHONPATH that leaves only the core importable, and pytest."""
    folder = tmp_path_factory.mktemp("core")
    allowed = with_requirements([*declared()[0], "pytest"])
    modules = [
        module
        for module, distributions in metadata.packages_distributions().items()
        if {name.lower().replace("_", "-") for name in distributions} & allowed
    ]
    (folder / "allowed.txt").write_text("\n".join(modules))
    (folder / "sitecustomize.py").write_text(SITE)
    return folder
