"""Words of the command line that name choices: tables and models."""

from __future__ import annotations

from pathlib import Path

MODEL = "model:"
TABLES = (".csv", ".tsv", ".txt", ".parquet")


def split_label(word: str) -> tuple[str, str]:
    """Return the label of a group and what it is.

    >>> split_label("people=human.csv"), split_label("data/human.csv"), split_label("model:hybrid")
    (('people', 'human.csv'), ('human', 'data/human.csv'), ('hybrid', 'model:hybrid'))
    """
    label, separator, rest = word.partition("=")
    if separator and rest:
        return label, rest
    return (Path(word).stem if word.endswith(TABLES) else word.removeprefix(MODEL)), word


def names_choices(word: str) -> bool:
    """Return whether a word is a table of choices or a model.

    >>> [names_choices(word) for word in ("people=human.csv", "model:hybrid", "cleansac")]
    [True, True, False]
    """
    return split_label(word)[1].startswith(MODEL) or word.endswith(TABLES)
