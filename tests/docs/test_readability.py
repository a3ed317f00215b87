from itertools import chain

import pytest
from docs.readability import docstrings, findings, pages


def test_pages_and_docstrings_use_the_terms_of_the_field():
    found = {name: findings(prose)["private words"] for name, prose in chain(pages(), docstrings())}
    assert {name: words for name, words in found.items() if words} == {}


@pytest.mark.parametrize(
    ("text", "kind", "expected"),
    [
        ("Training beside a viewer.", "private words", ["beside"]),
        ("There is no GPU. This is not a test.", "private words", []),
        ("It is called often. A run ends.", "passive openings", ["It is called often."]),
        (" ".join(["word"] * 31) + ".", "long sentences", [" ".join(["word"] * 31) + "."]),
        (" ".join(["word"] * 30) + ".", "long sentences", []),
    ],
)
def test_what_counts(text, kind, expected):
    assert findings(text)[kind] == expected
