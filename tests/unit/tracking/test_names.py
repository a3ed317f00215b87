from __future__ import annotations

import itertools
import re

import pytest

from scilab_rl.tracking.names import encoded, is_plain_path

ASCII = re.compile(r"[^\w\-. :/]", re.ASCII)


def test_names_of_allowed_characters_stay_as_they_are() -> None:
    for name in ("train/critic_loss", "eval/success rate", "a_b", "time/f-p.s:1", "x_y", "_x"):
        assert encoded(name, ASCII) == name


def test_different_names_stay_different() -> None:
    """All names of up to four of the characters that could be confused."""
    alphabet = ("_", "x", "α", "β", "3", "b", "/", "[", " ")
    names = ["".join(word) for n in range(1, 5) for word in itertools.product(alphabet, repeat=n)]
    names += ["train/α", "train/β", "train/_", "train/_x3b1_", "train/_x5f_x3b1_", "train/_x3b1"]
    texts = {encoded(name, ASCII) for name in names}
    assert len(texts) == len({*names})
    assert not any(ASCII.search(text) for text in texts)


def test_long_names_end_with_a_hash_of_all_of_it() -> None:
    names = [f"train/{'x' * 300}{ending}" for ending in ("a", "b", "α")] + ["α" * 100, "α" * 101]
    texts = {encoded(name, ASCII, 250) for name in names}
    assert len(texts) == len(names)
    assert {len(text) for text in texts} == {250}
    assert encoded("x" * 250, ASCII, 250) == "x" * 250


@pytest.mark.parametrize("name", ["/a", "a/", "a//b", "a/./b", "a/../b", "..", ".", "..a"])
def test_paths_that_are_not_plain(name: str) -> None:
    assert not is_plain_path(name)
    assert is_plain_path("train/a.b") and is_plain_path("a")
