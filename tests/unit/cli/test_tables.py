import io
import os
import pty
import subprocess
import sys

import pytest

from scilab_rl.cli import tables

_SCRIPT = """
from scilab_rl.cli.tables import print_rows
rows = [{"name": "a" * 30, "status": "finished", "note": "n" * 12}]
print_rows(["name", "status", "note"], rows, optional=["note"])
"""


def on_terminal(columns: int, **environment: str) -> str:
    """Return what the script prints on a terminal of this width."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("CI", "NO_COLOR")}
    settings = inherited | {"TERM": "xterm", "COLUMNS": str(columns)} | environment
    leader, follower = pty.openpty()
    command = [sys.executable, "-c", _SCRIPT]
    with subprocess.Popen(command, stdout=follower, env=settings) as process:
        os.close(follower)
        output = b""
        try:
            while block := os.read(leader, 4096):
                output += block
        except OSError:  # Linux says so at the end
            pass
    os.close(leader)
    assert process.returncode == 0
    return output.decode().replace("\r\n", "\n")


def test_a_wide_terminal_shows_all_columns_in_color():
    output = on_terminal(100)
    heading, row = output.splitlines()
    assert "note" in heading
    assert "n" * 12 in row
    assert "\x1b[32mfinished" in row


def test_no_color_is_respected():
    assert "\x1b[32m" not in on_terminal(100, NO_COLOR="1")


def test_a_narrow_terminal_folds_and_leaves_out_optional_columns():
    output = on_terminal(30, NO_COLOR="1")
    assert "status" in output
    assert "note" not in output
    assert all(
        len(line.replace("\x1b[1m", "").replace("\x1b[0m", "")) <= 30
        for line in output.splitlines()
    )


def test_twenty_columns_show_one_value_per_line():
    lines = on_terminal(20).splitlines()
    assert lines == [f"name: {'a' * 30}", "status: finished", f"note: {'n' * 12}", ""]


@pytest.mark.parametrize("variable", [{"TERM": "dumb"}, {"CI": "true"}])
def test_plain_terminals_get_tab_separated_lines(variable):
    assert on_terminal(100, **variable).splitlines()[0] == "name\tstatus\tnote"


def test_cells_hold_no_tabs_or_line_ends(capsys):
    tables.print_rows(["a", "b", "c", "d"], [{"a": "x\ty\nz", "b": None, "c": True, "d": 0.123456}])
    assert capsys.readouterr().out == "a\tb\tc\td\nx y z\t-\tyes\t0.123\n"


def test_an_ascii_output_replaces_other_letters(monkeypatch):
    output = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", output)
    tables.print_rows(["name"], [{"name": "Grüße"}])
    assert output.buffer.getvalue() == b"name\nGr??e\n"


@pytest.mark.parametrize(
    ("value", "typed"),
    [
        (None, "null"),
        (False, "false"),
        ("", "''"),
        ("auto", "auto"),
        ([1, 2], "[1, 2]"),
        (0.5, "0.5"),
    ],
)
def test_values_are_shown_as_they_are_typed(value, typed):
    assert tables.as_typed(value) == typed
