"""Watching while it learns: a Rerun viewer in a window or in the browser, on this machine only."""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import getpass
import importlib.util
import json
import logging
import os
import queue
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
from pathlib import Path
from typing import IO, Any

from scilab_rl.errors import ConfigError
from scilab_rl.recording.records import ClipInfo, Record
from scilab_rl.recording.viewer_stream import (
    APPLICATION,
    ViewerStream,
    import_rerun,
    layout,
)

_log = logging.getLogger(__name__)
LOOPBACK = "127.0.0.1"
DATA_PORT, PAGE_PORT = 9876, 9090
_N_PORTS = 50
_WAITING_PICTURES = 64  # beyond that, pictures are dropped, numbers never
_PAUSE = 0.05  # seconds between two deliveries: scenes that go together cost the training less
_TOGETHER = 32  # scenes in one delivery
_PATIENCE = 2.0  # seconds for what is waiting at the end
_MEMORY = "512MiB"  # of the server; the oldest scenes go first
_PAGE_ENDS = 5.0  # seconds that are waited for it
# Keeps the page from outliving a program that is killed: its own death closes the pipe.
_GUARD = """
import subprocess, sys
page = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
sys.stdin.read()
page.terminate()
try:
    page.wait(2)
except subprocess.TimeoutExpired:
    page.kill()
"""


class LiveViewer:
    """Streams records to a viewer, from a thread of its own that training never waits for.

    Args:
        panels: Names of all metrics that will be shown.
        host: Address to listen on; anything but 127.0.0.1 can be seen by others.
        window: Whether to open a window; None: when there is a display.
    """

    def __init__(
        self, panels: tuple[str, ...], *, host: str = LOOPBACK, window: bool | None = None
    ) -> None:
        rerun = import_rerun("for the live view (render=display)")
        if host != LOOPBACK:
            _log.warning(
                "The live view listens on %s: anyone who can reach this machine can watch.", host
            )
        self._rerun = rerun
        self._recording, self.uri, self.data_port = serve_data(panels, host)
        self._host = host
        self.address: str | None = None
        self.n_dropped_pictures = 0
        self._page: subprocess.Popen[bytes] | None = None
        self._is_closing = threading.Event()
        if has_display() if window is None else window:
            self._open_window()
        else:
            self._open_page()
        self._queue: queue.SimpleQueue[ClipInfo | tuple[Record, float] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="live view", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    @property
    def n_waiting(self) -> int:
        """How many scenes have not been passed on yet."""
        return self._queue.qsize()

    def begin(self, clip: ClipInfo) -> None:
        """Begin a clip."""
        self._queue.put(clip)

    def add(self, record: Record) -> None:
        """Pass on a scene; only its numbers when too many pictures are waiting."""
        if self.n_waiting >= _WAITING_PICTURES:
            if not self.n_dropped_pictures:
                _log.warning(
                    "The viewer is too slow: pictures are dropped, numbers are not. Training "
                    "continues."
                )
            self.n_dropped_pictures += 1
            # It may wait for long, and the viewer shows no observation.
            record = dataclasses.replace(record, picture=b"", observation=None, state=None)  # type: ignore[arg-type]
        self._queue.put((record, time.time()))

    def end(self) -> None:
        """Finish a clip."""

    def close(self) -> None:
        """End the servers; what is still waiting gets two seconds. A window stays open."""
        if self._is_closing.is_set():
            return
        self._is_closing.set()
        atexit.unregister(self.close)
        self._queue.put(None)
        self._thread.join(_PATIENCE)
        if self._thread.is_alive():  # the viewer is stuck, and the package would wait for it
            atexit.unregister(self._rerun.rerun_shutdown)
        _end_page(self._page)
        _log.info(
            "The live view has ended; a window or page that is open keeps what it has shown. "
            "To keep episodes in files: render=record, or scilab-rl play last --record."
        )

    def _work(self) -> None:
        stream = ViewerStream(self._recording)
        scenes: list[tuple[Record, float]] = []
        is_over = False
        try:
            while not is_over:
                item = self._queue.get()
                is_over = item is None
                if isinstance(item, tuple):
                    scenes.append(item)
                    if self.n_waiting and len(scenes) < _TOGETHER:
                        continue
                if scenes:
                    stream.add(*zip(*scenes, strict=True))
                    scenes.clear()
                if isinstance(item, ClipInfo):
                    stream.begin(item)
                elif not self.n_waiting:
                    self._is_closing.wait(_PAUSE)
        except Exception as error:  # noqa: BLE001 - showing must not end the training
            _log.warning("The live view has ended: %s. Training continues.", error)

    def _open_page(self) -> None:
        page_port = free_port(PAGE_PORT, self._host, avoid=self.data_port)
        self._page = serve_page(self.uri, self._host, page_port)
        self.address = page_address(self.uri, self._host, page_port)
        _log.info("Live view: %s", self.address)
        if self._host == LOOPBACK:
            _log.info("%s", ssh_line(page_port, self.data_port))

    def _open_window(self) -> None:
        window = Window(self.uri)
        _log.info("Live view: in a window; the data are served at %s.", self.uri)
        watching = threading.Thread(target=self._watch, args=(window,), name="window", daemon=True)
        watching.start()

    def _watch(self, window: Window) -> None:
        """Wait for the end of a window; one that fails is replaced by the page."""
        reason = window.wait()
        if reason is not None and not self._is_closing.is_set():
            _log.warning("No window can be opened (%s). The browser shows it instead:", reason)
            self._open_page()


class Window:
    """The viewer in a window of its own; it belongs to the user and outlives us.

    It listens, too, but to this machine only.

    Args:
        source: Address of a data server, or path of a recording.
    """

    def __init__(self, source: str) -> None:
        self._said = tempfile.TemporaryFile()
        self.process = start_viewer([source, "--bind", LOOPBACK, "--port", "0"], self._said)

    def wait(self) -> str | None:
        """Wait until it is closed; return why it failed, or None if it did not."""
        self.process.wait()
        with self._said as said:
            said.seek(0)
            lines = said.read().decode(errors="replace").strip().splitlines()
        if not self.process.returncode:
            return None
        return lines[-1] if lines else f"exit code {self.process.returncode}"


def serve_data(panels: tuple[str, ...], host: str) -> tuple[Any, str, int]:
    """Serve a new recording from this process.

    Args:
        panels: Names of all metrics that will be shown.
        host: Address to listen on.

    Returns:
        The recording, the address for a viewer, and its port.

    Raises:
        ConfigError: If 50 ports in a row are taken, or the address is not one of this machine.
    """
    rerun = import_rerun("for the live view (render=display)")
    port = DATA_PORT
    while True:
        port = free_port(port, host)
        recording = rerun.RecordingStream(APPLICATION)
        sink = rerun.GrpcServerSink(bind_ip=host, port=port, server_memory_limit=_MEMORY)
        recording.set_sinks(sink, default_blueprint=layout(panels))
        try:
            recording.flush(timeout_sec=_PATIENCE)
        except RuntimeError as error:  # another process took this port
            _log.debug("Port %d: %s", port, error)
            port += 1
        else:
            return recording, sink.uri, port


def serve_page(source: str, host: str, page_port: int) -> subprocess.Popen[bytes]:
    """Start the web viewer's server, which ends when the pipe to its guard is closed.

    Args:
        source: Address of a data server, or path of a recording.
        host: Address to listen on.
        page_port: Port of the page.
    """
    options = ["--serve-web", "--bind", host, "--web-viewer-port", str(page_port)]
    guard = (sys.executable, "-I", "-S", "-c", _GUARD)
    return start_viewer([source, *options, "--port", "0"], subprocess.DEVNULL, guard)


def page_address(uri: str, host: str, page_port: int) -> str:
    """Return the address to open in a browser."""
    return f"http://{host}:{page_port}/?url={urllib.parse.quote(uri, safe='')}"


def ssh_line(*ports: int) -> str:
    """Return the command that makes ports of this machine those of another one."""
    forwards = " ".join(f"-L {port}:{LOOPBACK}:{port}" for port in ports)
    return f"From another machine first: ssh {forwards} {getpass.getuser()}@{socket.gethostname()}"


def free_port(first: int, host: str = LOOPBACK, *, avoid: int = -1) -> int:
    """Return the first free port from ``first`` on.

    Raises:
        ConfigError: If 50 in a row are taken, or the address is not one of this machine.
    """
    for port in range(first, first + _N_PORTS):
        with socket.socket() as listener:
            try:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listener.bind((host, port))
            except OSError:
                continue
        if port != avoid:
            return port
    raise ConfigError(f"No port from {first} to {first + _N_PORTS - 1} is free on {host}.")


def has_display() -> bool:
    """Return whether a window can be opened."""
    if sys.platform in ("darwin", "win32"):
        return "SSH_CONNECTION" not in os.environ
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def start_viewer(
    arguments: list[str], stderr: int | IO[bytes], guard: tuple[str, ...] = ()
) -> subprocess.Popen[bytes]:
    """Start the viewer's program, with its collection of usage data switched off.

    Args:
        arguments: Of the program.
        stderr: Where it complains.
        guard: What starts it and reads from a pipe of ours; nothing: it is our own child.
    """
    return subprocess.Popen(
        [*guard, str(_program()), *arguments],
        env=os.environ | {"XDG_CONFIG_HOME": _quiet_configuration()},
        stdin=subprocess.PIPE if guard else subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        start_new_session=True,  # Ctrl-C is for the training
    )


def _program() -> Path:
    """Return the viewer's executable itself, so that it is our own child that we end."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        import_rerun("to start the viewer")
        raise ConfigError("The package rerun-sdk is installed without its viewer.")
    suffix = ".exe" if sys.platform == "win32" else ""
    folder = Path(spec.origin).parent
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return bundled if bundled.exists() else folder / f"rerun{suffix}"


def _quiet_configuration() -> str:
    """Return a configuration folder for the viewer in which usage data are switched off."""
    folder = Path(tempfile.mkdtemp(prefix="scilab-rl-viewer-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "rerun").mkdir()
    settings = {"analytics_enabled": False, "analytics_id": "", "metadata": {}}
    (folder / "rerun" / "analytics.json").write_text(json.dumps(settings), encoding="utf-8")
    return str(folder)


def _end_page(guard: subprocess.Popen[bytes] | None) -> None:
    if guard is not None:
        assert guard.stdin is not None
        guard.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            guard.wait(_PAGE_ENDS)
