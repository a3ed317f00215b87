"""Watching while it learns: a Rerun viewer in a window or in the browser, on this machine only."""

from __future__ import annotations

import atexit
import contextlib
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
import urllib.parse
from pathlib import Path
from typing import Any

from scilab_rl.errors import ConfigError
from scilab_rl.visualization.records import ClipInfo, Record
from scilab_rl.visualization.viewer_stream import (
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
_MEMORY = "512MiB"  # of the server; the oldest scenes go first
_STOP = object()


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
                "The live view listens on %s: everybody who can reach this machine can look.", host
            )
        self._recording = rerun.RecordingStream(APPLICATION)
        self.data_port = free_port(DATA_PORT, host)
        sink = rerun.GrpcServerSink(bind_ip=host, port=self.data_port, server_memory_limit=_MEMORY)
        self._recording.set_sinks(sink, default_blueprint=layout(panels))
        self.address: str | None = None
        self.n_dropped_pictures = 0
        self._child = self._open_viewer(sink.uri, host, has_display() if window is None else window)
        self._queue: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="live view", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def begin(self, clip: ClipInfo) -> None:
        """Begin a clip."""
        self._queue.put(clip)

    def add(self, record: Record) -> None:
        """Pass on a scene; its picture is dropped when too many are waiting."""
        with_picture = self._queue.qsize() < _WAITING_PICTURES
        self.n_dropped_pictures += not with_picture
        self._queue.put((record, with_picture))

    def end(self) -> None:
        """Finish a clip."""

    def close(self) -> None:
        """End the viewer's server; what is still waiting gets two seconds."""
        atexit.unregister(self.close)
        self._queue.put(_STOP)
        self._thread.join(2.0)
        _end_child(self._child)

    def _work(self) -> None:
        stream = ViewerStream(self._recording)
        while (item := self._queue.get()) is not _STOP:
            try:
                if isinstance(item, ClipInfo):
                    stream.begin(item)
                else:
                    record, with_picture = item
                    stream.add(record, with_picture=with_picture)
            except Exception as error:  # noqa: BLE001 - showing must not end the training
                _log.warning("The live view has ended: %s. Training goes on.", error)
                return

    def _open_viewer(self, uri: str, host: str, window: bool) -> subprocess.Popen[bytes] | None:
        if window:
            _log.info("Live view: in a window; the data are served at %s.", uri)
            return start_viewer([uri, "--port", "0"])
        page_port = free_port(PAGE_PORT, host, avoid=self.data_port)
        child = serve_page(uri, host, page_port)
        self.address = page_address(uri, host, page_port)
        _log.info("Live view: %s", self.address)
        if host == LOOPBACK:
            _log.info("%s", ssh_line(page_port, self.data_port))
        return child


def serve_page(source: str, host: str, page_port: int) -> subprocess.Popen[bytes]:
    """Start the web viewer's server as a child process.

    Args:
        source: Address of a data server, or path of a recording.
        host: Address to listen on.
        page_port: Port of the page.
    """
    options = ["--serve-web", "--bind", host, "--web-viewer-port", str(page_port)]
    return start_viewer([source, *options, "--port", "0"])


def page_address(uri: str, host: str, page_port: int) -> str:
    """Return the address to open in a browser."""
    return f"http://{host}:{page_port}/?url={urllib.parse.quote(uri, safe='')}"


def ssh_line(*ports: int) -> str:
    """Return the command that makes ports of this machine those of another one."""
    forwards = " ".join(f"-L {port}:{LOOPBACK}:{port}" for port in ports)
    return f"From another machine first: ssh {forwards} {getpass.getuser()}@{socket.gethostname()}"


def start_viewer(arguments: list[str]) -> subprocess.Popen[bytes]:
    """Start the viewer's program, with its collection of usage data switched off."""
    return subprocess.Popen(
        [str(_program()), *arguments],
        env=os.environ | {"XDG_CONFIG_HOME": _quiet_configuration()},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


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
    """Tell whether a window can be opened."""
    if sys.platform in ("darwin", "win32"):
        return "SSH_CONNECTION" not in os.environ
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


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


def _end_child(child: subprocess.Popen[bytes] | None) -> None:
    if child is None or child.poll() is not None:
        return
    child.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(3)
        return
    child.kill()
    child.wait()
