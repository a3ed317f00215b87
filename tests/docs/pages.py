"""The pages of the documentation as tests see them: blocks, and what a comment says about each."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
_BLOCK = re.compile(
    r"(?P<comments>(?:^[ ]*<!-- (?:test|story|task): [^\n]* -->\n)*)"
    r"^(?P<indent>[ ]*)```(?P<language>\w+)(?: title=\"(?P<title>[^\"]+)\")?[^\n]*\n"
    r"(?P<text>.*?)^[ ]*```[ ]*$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes:
        line: Its line in the page, from 1.
        language: ``bash``, ``python``, ``yaml``, or one that is shown only.
        text: What is in it.
        title: The file to write, if one is named.
        comments: What the ``<!-- test: ... -->`` lines before it say.
        story: What a ``<!-- story: ... -->`` line before it says.
        task: The one of the six tasks that it belongs to, by a ``<!-- task: ... -->`` line.
    """

    line: int
    language: str
    text: str
    title: str | None
    comments: tuple[str, ...]
    story: str | None
    task: str | None

    def said(self, word: str) -> str | None:
        """Return what follows a word in the comments; None when none begins with it."""
        for comment in self.comments:
            if comment == word or comment.startswith((f"{word} ", f"{word}, ")):
                return comment[len(word) :].lstrip(", ")
        return None

    @property
    def commands(self) -> list[str]:
        """The lines of a shell block, without comments; a backslash continues a line."""
        lines = self.text.replace("\\\n", " ").splitlines()
        stripped = (re.sub(r"\s+#\s.*$", "", line).strip() for line in lines)
        return [line for line in stripped if line and not line.startswith("#")]


def pages() -> list[Path]:
    """Return all pages."""
    return sorted(DOCS.rglob("*.md"))


def blocks_of(page: Path) -> list[Block]:
    """Return the blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(
            line=text.count("\n", 0, match.start("language")) + 1,
            language=match["language"],
            text=re.sub(rf"(?m)^{match['indent']}", "", match["text"]),
            title=match["title"],
            comments=tuple(re.findall(r"<!-- test: (.*?) -->", match["comments"])),
            story=next(iter(re.findall(r"<!-- story: (.*?) -->", match["comments"])), None),
            task=next(iter(re.findall(r"<!-- task: (.*?) -->", match["comments"])), None),
        )
        for match in _BLOCK.finditer(text)
    ]


def insert_after(text: str, line: str, new: str) -> str:
    """Return the text with new lines after the only line that reads so, whatever its indent.

    Raises:
        AssertionError: If there is no such line, or there are several.
    """
    lines = text.splitlines(keepends=True)
    places = [index for index, entry in enumerate(lines) if entry.strip() == line]
    assert len(places) == 1, f"{len(places)} lines read {line!r}"
    return "".join([*lines[: places[0] + 1], new, *lines[places[0] + 1 :]])
