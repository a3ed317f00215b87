"""``scilab-rl view RUN``: look at recorded episodes again."""

from __future__ import annotations

import argparse
import functools
import http
import http.server
import importlib.util
import io
import logging
import urllib.parse
import webbrowser
from pathlib import Path
from typing import BinaryIO

from scilab_rl.cli.parser import CommandParser
from scilab_rl.errors import ConfigError
from scilab_rl.files import shown
from scilab_rl.recording.live import (
    LOOPBACK,
    PAGE_PORT,
    Window,
    free_port,
    has_display,
    ssh_line,
)
from scilab_rl.run.directory import find_run
from scilab_rl.run.recordings import chosen_recordings, recordings_of

_log = logging.getLogger(__name__)
_LOCAL_NAMES = (LOOPBACK, "localhost", "::1")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    run = find_run(options.run, options.base_logdir)
    if options.list:
        for number, path in enumerate(recordings_of(run), start=1):
            _log.info("%3d  %s", number, path.stem)
        return 0
    recording = chosen_recordings(run, options.episode)[0]
    show(recording, in_browser=options.browser)
    return 0


def show(recording: Path, *, in_browser: bool) -> None:
    """Open an episode in the viewer's window or, without one, in the browser."""
    viewer_file, page = recording.with_suffix(".rrd"), recording.with_suffix(".html")
    has_viewer = viewer_file.is_file() and importlib.util.find_spec("rerun_cli") is not None
    if has_display() and has_viewer and not in_browser:
        reason = Window(str(viewer_file)).wait()
        if reason is None:
            return
        _log.warning("No window can be opened (%s). The page shows it too:", reason)
    _log.info("%s", shown(page))
    if not page.is_file():
        raise ConfigError(f"'{page}' does not exist. `scilab-rl probe` makes it again.")
    if has_display() and webbrowser.open(page.resolve().as_uri()):
        return
    _serve(page)


def _serve(page: Path) -> None:
    """Serve the pages of a run to this machine until Ctrl-C."""
    port = free_port(PAGE_PORT)
    handler = functools.partial(LocalHandler, directory=str(page.parent))
    with http.server.ThreadingHTTPServer((LOOPBACK, port), handler) as server:
        _log.info("There is no display here. Open http://%s:%d/%s", LOOPBACK, port, page.name)
        _log.info("%s   (end with Ctrl-C)", ssh_line(port))
        server.serve_forever()


class LocalHandler(http.server.SimpleHTTPRequestHandler):
    """Gives files to a browser on this machine that asks for them by this machine's name.

    A web page from elsewhere could let its own name point to 127.0.0.1 and read what is served here
    (DNS rebinding); its name then stands in the request.
    """

    def send_head(self) -> io.BytesIO | BinaryIO | None:
        """Begin the answer, or refuse."""
        asked_for = [f"//{self.headers.get('Host', '')}", self.headers.get("Origin")]
        if not all(address is None or _is_local(address) for address in asked_for):
            self.send_error(http.HTTPStatus.FORBIDDEN)
            return None
        return super().send_head()

    def list_directory(self, path: object) -> None:
        """Refuse: only the pages themselves are served."""
        self.send_error(http.HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *args: object) -> None:
        """Write requests to the log."""
        _log.debug(format, *args)


def _is_local(address: str) -> bool:
    try:
        return urllib.parse.urlsplit(address).hostname in _LOCAL_NAMES
    except ValueError:  # no address at all
        return False


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser("view", "Look at recorded episodes.", run=True, base=True)
    parser.add_argument("--episode", default="last", help="number or name (default: the last one)")
    parser.add_argument("--browser", action="store_true", help="the page, not the viewer's window")
    parser.add_argument("--list", action="store_true", help="list the recorded episodes")
    return parser.parse_args(arguments)
