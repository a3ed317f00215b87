"""What the pages that commands serve have in common: who may ask, answers, the end by Ctrl-C."""

from __future__ import annotations

import http.server
import ipaddress
import logging
import signal
import socket
import webbrowser
from typing import Any

_log = logging.getLogger(__name__)
LOOPBACK = "127.0.0.1"


class PageHandler(http.server.SimpleHTTPRequestHandler):
    """Answers requests that were sent to this machine under its own name."""

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing about requests."""

    def refuses_foreign(self) -> bool:
        """Refuse a page of another site that asks under a name that it lets mean our address.

        See "DNS rebinding". A server that listens to others answers under any number address.

        Returns:
            Whether the request was refused.
        """
        host = self.headers.get("Host", "").rpartition(":")[0].strip("[]")
        known = {LOOPBACK, "localhost"}
        assert isinstance(self.server, http.server.HTTPServer)
        listens_to = str(self.server.server_address[0])
        if listens_to != LOOPBACK:
            known |= {listens_to, socket.gethostname()}
            known |= {host} if _is_address(host) else set()
        if host in known:
            return False
        self.send_error(403, "This page is for this machine only.")
        return True

    def answer(self, kind: str, text: str, status: int = 200, **headers: str) -> None:
        """Send text that is not kept by the browser."""
        body = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def serve_until_interrupted(
    server: http.server.ThreadingHTTPServer, address: str, name: str, *, opens: bool
) -> None:
    """Serve until Ctrl-C.

    Args:
        server: Closed by the caller.
        address: Where a browser finds it.
        name: What it shows, for messages.
        opens: Whether to open a browser.
    """
    from scilab_rl.recording.live import ssh_line

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    _log.info("%s: %s (Ctrl-C ends it)", name, address)
    if server.server_address[0] == LOOPBACK:
        _log.info("%s", ssh_line(server.server_port))
    if opens:
        webbrowser.open(address)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        _log.info("The %s is no longer served.", name.lower())
