"""``scilab-rl board``: all runs and studies on one page: a file, or served and kept up to date."""

from __future__ import annotations

import http.server
import json
import logging
import sys
import threading
import webbrowser
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.serving import LOOPBACK, PageHandler, serve_until_interrupted
from scilab_rl.errors import ConfigError

if TYPE_CHECKING:  # heavy
    from scilab_rl.analysis.board import BoardReader

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser("board", "Show all runs and studies on one page.", base=True)
    add = parser.add_argument
    add("--output", type=Path, metavar="FILE", help="default: board.html in the folder of all runs")
    add("--watch", action="store_true", help="serve it, refreshed while runs train")
    add("--port", type=positive, default=8765, help="of --watch; default: 8765, or the next free")
    add("--no-browser", action="store_true", help="only print where it is")
    options = parser.parse_args(arguments)
    base = options.base_logdir
    if not base.is_dir():
        raise ConfigError(f"There is no folder '{base}': train a run first.")
    if options.watch:
        _serve(base, options.port, opens=not options.no_browser)
        return 0
    from scilab_rl.analysis.board import write_board

    page = write_board(base, options.output)
    _log.info("%s", page)
    if not options.no_browser and sys.stdout.isatty():
        webbrowser.open(page.resolve().as_uri())
    return 0


class BoardServer(http.server.ThreadingHTTPServer):
    """Serves the board of a folder, and the files that it links, to this machine only.

    Args:
        base: The folder of all runs.
        port: The port; 0: any.
    """

    def __init__(self, base: Path, port: int) -> None:
        from scilab_rl.analysis.board import BoardReader

        self.reader: BoardReader = BoardReader(base)
        self.reading = threading.Lock()
        super().__init__((LOOPBACK, port), partial(_Handler, directory=str(base.resolve())))

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{LOOPBACK}:{self.server_port}/"


class _Handler(PageHandler):
    server: BoardServer

    def do_GET(self) -> None:
        """Answer with the page, its data, their version, or a file of the folder."""
        if self.refuses_foreign():
            return
        answers = {"/": self._page, "/version": self._version, "/board.json": self._data}
        answer = answers.get(self.path.partition("?")[0])
        if answer is None:
            super().do_GET()
            return
        with self.server.reading:
            kind, text = answer()
        self.answer(kind, text)

    def do_HEAD(self) -> None:
        """Answer for files, to this machine only."""
        if not self.refuses_foreign():
            super().do_HEAD()

    def _page(self) -> tuple[str, str]:
        from scilab_rl.analysis.board import render_board

        return "text/html", render_board(self.server.reader.read(), watches=True)

    def _data(self) -> tuple[str, str]:
        return "application/json", json.dumps(self.server.reader.read())

    def _version(self) -> tuple[str, str]:
        return "text/plain", self.server.reader.version()


def _serve(base: Path, port: int, *, opens: bool) -> None:
    """Serve until Ctrl-C."""
    from scilab_rl.recording.live import free_port

    with BoardServer(base, free_port(port)) as server:
        serve_until_interrupted(server, server.address, "Board", opens=opens)
