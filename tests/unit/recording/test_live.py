"""The live view: on this machine only, and never in the way."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import psutil
import pytest

from scilab_rl.recording.live import LiveViewer, free_port, has_display, serve_data
from scilab_rl.recording.records import Record

from .clips import make_clip

pytest.importorskip("rerun")


SHOWING = """
import time
from scilab_rl.recording.live import LiveViewer
print(LiveViewer((), window=False)._page.pid, flush=True)
time.sleep(60)
"""


@pytest.fixture
def viewer() -> Iterator[LiveViewer]:
    viewer = LiveViewer(("reward", "q_values"), window=False)
    yield viewer
    viewer.close()


def show(viewer: LiveViewer, n_episodes: int) -> None:
    clip = make_clip()
    for _ in range(n_episodes):
        viewer.begin(clip.info)
        for record in clip.records:
            viewer.add(record)
        viewer.end()


def listening_addresses(*processes: psutil.Process) -> set[str]:
    return {
        connection.laddr.ip
        for process in processes
        for connection in process.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    }


def wait_for(find: Callable[[], list[psutil.Process]]) -> list[psutil.Process]:
    deadline = time.monotonic() + 20
    while not (found := find()) and time.monotonic() < deadline:
        time.sleep(0.05)
    return found


def wait_for_page(viewer: LiveViewer) -> None:
    deadline = time.monotonic() + 20
    assert viewer.address is not None
    while time.monotonic() < deadline:
        try:
            with urllib.request.urlopen(viewer.address, timeout=2) as page:
                assert page.status == 200
                return
        except OSError:
            time.sleep(0.1)
    pytest.fail("the page is not served")


def page_of(viewer: LiveViewer) -> psutil.Process:
    """Return the page's server, the only child of its guard."""
    wait_for_page(viewer)
    assert viewer._page is not None
    (server,) = psutil.Process(viewer._page.pid).children()
    return server


def test_page_is_served_to_this_machine_only(viewer: LiveViewer) -> None:
    server = page_of(viewer)
    show(viewer, 2)
    assert listening_addresses(psutil.Process(), server) == {"127.0.0.1"}


def test_child_ends_with_the_view() -> None:
    viewer = LiveViewer(("reward",), window=False)
    assert viewer._page is not None
    server, guard = page_of(viewer), psutil.Process(viewer._page.pid)
    viewer.close()
    assert not server.is_running()
    assert not guard.is_running()


@pytest.mark.parametrize("is_stuck", [False, True])
def test_page_ends_with_a_program_that_is_killed(tmp_path: Path, is_stuck: bool) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", SHOWING], stdout=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert program.stdout is not None
    guard = psutil.Process(int(program.stdout.readline()))
    (server,) = wait_for(guard.children)
    if is_stuck:
        server.suspend()
    program.kill()
    program.wait()
    program.stdout.close()
    _, alive = psutil.wait_procs([server, guard], timeout=20)
    assert not alive


def test_stopped_and_killed_pages_stop_nobody(viewer: LiveViewer) -> None:
    server = page_of(viewer)
    server.suspend()
    started = time.monotonic()
    show(viewer, 100)
    assert time.monotonic() - started < 2.0
    server.kill()
    show(viewer, 1)


def test_pictures_are_dropped_and_numbers_never(
    viewer: LiveViewer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """While the thread hangs in the viewer, training goes on; then all numbers arrive."""
    written: list[Record] = []
    hanging = True

    def slow_add(self: object, records: Sequence[Record], seconds: Sequence[float]) -> None:
        while hanging:
            time.sleep(0.01)
        written.extend(records)

    monkeypatch.setattr("scilab_rl.recording.viewer_stream.ViewerStream.add", slow_add)
    show(viewer, 40)
    assert viewer.n_dropped_pictures > 100
    hanging = False
    deadline = time.monotonic() + 10
    while len(written) < 40 * 5 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert [record.reward for record in written] == [0.0, 1.0, 2.0, 3.0, None] * 40
    dropped = [record for record in written if not record.picture]
    assert len(dropped) == viewer.n_dropped_pictures
    assert all(record.observation is None for record in dropped)  # they may wait for long
    assert [r.message for r in caplog.records if "is too slow" in r.message] == [
        "The viewer is too slow: pictures are dropped, numbers are not. Training continues."
    ]


def test_next_port_is_taken_when_one_is_not_free() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port(port) > port


@pytest.mark.parametrize(
    ("environment", "expected"), [({}, False), ({"DISPLAY": ":0"}, True), ({"DISPLAY": ""}, False)]
)
def test_display(
    environment: dict[str, str], expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert has_display() is expected


def test_port_that_is_taken_in_the_last_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the look for a free port and its use, somebody else takes it."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setattr("scilab_rl.recording.live.DATA_PORT", port)
        monkeypatch.setattr(
            "scilab_rl.recording.live.free_port",
            lambda first, *_, **__: first if first == port else free_port(first),
        )
        recording, uri, chosen = serve_data(("reward",), "127.0.0.1")
    assert chosen > port
    assert f":{chosen}/" in uri
    with socket.create_connection(("127.0.0.1", chosen), timeout=5):
        pass
    recording.disconnect()
