"""The examples in docstrings say what happens."""

from __future__ import annotations

import doctest
import importlib
import importlib.util
from pathlib import Path

import pytest

from .pages import ROOT

SOURCE = ROOT / "src" / "scilab_rl"
NEEDS = {
    "jax_engine": "jax",
    "jax_off_policy": "jax",
    "jaxcrl": "jax",
    "jaxgciql": "jax",
    "jaxsac": "jax",
    "jaxtd3": "jax",
}


def modules_with_examples() -> list[Path]:
    """Return the files of the framework with an example in them."""
    return [p for p in sorted(SOURCE.rglob("*.py")) if ">>> " in p.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", modules_with_examples(), ids=lambda p: p.stem)
def test_examples(path: Path) -> None:
    if path.stem in NEEDS:
        pytest.importorskip(NEEDS[path.stem])
    name = ".".join(path.relative_to(SOURCE.parent).with_suffix("").parts)
    result = doctest.testmod(importlib.import_module(name.removesuffix(".__init__")))
    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.parametrize("name", ["docs/generate.py", "scripts/measure_code.py"])
def test_examples_of_scripts(name: str) -> None:
    spec = importlib.util.spec_from_file_location("script", ROOT / name)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    result = doctest.testmod(module)
    assert (result.failed, result.attempted > 0) == (0, True)
