import hashlib
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from scilab_rl import files


def test_a_file_is_replaced_and_nothing_else_remains(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "old")
    files.write_text(path, "new ü")
    assert path.read_bytes() == "new ü".encode()
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_in_the_middle_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "old")

    def half(file):
        file.write(b"ne")
        raise ValueError("in the middle")

    with pytest.raises(ValueError, match="in the middle"):
        files.atomic_write(path, half)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "old")
    code = """
        import resource, signal, sys
        from pathlib import Path
        from scilab_rl import files
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
        files.write_text(Path(sys.argv[1]), "x" * 5000)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), path],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "File too large" in done.stderr
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_kill_in_the_middle_leaves_the_old_file_or_the_new_one(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "0" * 300_000)
    code = """
        import sys
        from pathlib import Path
        from scilab_rl import files
        print("ready", flush=True)
        while True:
            for digit in "0123456789":
                files.write_text(Path(sys.argv[1]), digit * 300_000)
    """
    for delay in (0.0, 0.01, 0.03, 0.1, 0.2):
        with subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(code), path], stdout=subprocess.PIPE
        ) as writer:
            writer.stdout.readline()
            time.sleep(delay)
            writer.send_signal(signal.SIGKILL)
        text = path.read_text()
        assert len(text) == 300_000
        assert len(set(text)) == 1


def test_json_keeps_the_order_of_its_keys(tmp_path):
    files.write_json(tmp_path / "a.json", {"b": 1, "a": [1.5, None]})
    text = (tmp_path / "a.json").read_text()
    assert json.loads(text) == {"b": 1, "a": [1.5, None]}
    assert text.index('"b"') < text.index('"a"')
    assert text.endswith("}\n")


def test_a_link_is_relative_and_replaced_at_once(tmp_path):
    for name in ("one", "two"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        files.point_to(tmp_path / "last", tmp_path / "runs" / name)
    assert (tmp_path / "last").readlink() == Path("runs/two")
    assert {path.name for path in tmp_path.iterdir()} == {"runs", "last"}


def test_a_link_that_cannot_be_made_is_no_error(tmp_path):
    (tmp_path / "last").mkdir()
    (tmp_path / "last" / "full").touch()
    files.point_to(tmp_path / "last", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"last"}


def test_the_checksum_is_that_of_the_whole_file(tmp_path):
    content = os.urandom(3 * 2**20 + 17)
    (tmp_path / "a").write_bytes(content)
    assert files.sha256(tmp_path / "a") == hashlib.sha256(content).hexdigest()


def test_a_path_is_shown_from_here_where_it_is_below(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert files.shown(tmp_path / "data" / "run") == "data/run"
    assert files.shown(Path("data/run")) == "data/run"
    assert files.shown(tmp_path.parent / "other") == str(tmp_path.parent / "other")
