"""``scilab-rl human env=TASK``: a page on which people play a task; each choice is kept."""

from __future__ import annotations

import argparse
import http.server
import json
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.serving import LOOPBACK, PageHandler, serve_until_interrupted
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError, ScilabRLError

if TYPE_CHECKING:  # heavy
    from scilab_rl.run.human import HumanSessions

_log = logging.getLogger(__name__)
FOLDER = "human"
_LARGEST = 10_000  # bytes of a request
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'"
)
# Blocks by family of tasks: games and searches are short.
_BLOCKS = {"horizon": 20, "hidden_goal": 10, "movement": 10}
_FEEDBACK_MS = {"hidden_goal": 0, "movement": 0}


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    if not any(word.startswith("env=") for word in options.words):
        raise ConfigError("human requires a task: scilab-rl human env=TwoStep.")
    instructions = _read_instructions(options.instructions) if options.instructions else None
    open_project()
    from scilab_rl.recording.live import free_port

    if options.host != LOOPBACK:
        _log.warning(
            "The page listens on %s, without encryption: anyone who can reach this machine can "
            "take part, also under the code of another participant.",
            options.host,
        )
    with HumanServer(
        lambda: _open_sessions(options),
        (options.host, free_port(options.port, options.host)),
        instructions,
        options.feedback_ms,
    ) as server:
        _log.info("Choices: %s", server.table)
        serve_until_interrupted(server, server.address, "Page", opens=not options.no_browser)
    return 0


def _open_sessions(options: argparse.Namespace) -> HumanSessions:
    from scilab_rl.config.compose import compose
    from scilab_rl.envs.registration import resolve_env_id
    from scilab_rl.envs.run_env import RunEnv
    from scilab_rl.envs.vectorize import make_single_env
    from scilab_rl.run.directory import slug
    from scilab_rl.run.human import SETTINGS_FILE, HumanSessions, family_of
    from scilab_rl.seeding import resolve_seed

    cfg = compose(["tuned=false", *options.words])
    env_id, notice = resolve_env_id(cfg.env)
    if notice:
        _log.info(notice)
    folder = options.output or options.base_logdir / FOLDER / slug(env_id)
    seed = cfg.seed
    if not seed and (folder / SETTINGS_FILE).is_file():
        seed = int(json.loads((folder / SETTINGS_FILE).read_text(encoding="utf-8"))["seed"])
    cfg = replace(cfg, env=env_id, seed=resolve_seed(seed))
    env: RunEnv = make_single_env(cfg)
    n_blocks = options.blocks or _BLOCKS.get(family_of(env), 1)
    env.close()
    return HumanSessions(cfg, folder, n_practice=options.practice, n_blocks=n_blocks)


class HumanServer(http.server.ThreadingHTTPServer):
    """Serves a task to people.

    All that concerns environments happens in one thread, because pictures of simulators belong to
    the thread that has drawn the first one. So no two choices are made at once either.

    Args:
        open_sessions: Makes the sessions, in that thread.
        address: Address and port to listen on; port 0: any.
        instructions: Markdown; None: those that are shipped for the task.
        feedback_ms: How long feedback is shown before the next choice; None: as the task needs.
    """

    def __init__(
        self,
        open_sessions: Callable[[], HumanSessions],
        address: tuple[str, int],
        instructions: str | None = None,
        feedback_ms: int | None = None,
    ) -> None:
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="task")
        try:
            self.sessions = self.ask(open_sessions)
            super().__init__(address, _Handler)
        except BaseException:
            self._worker.shutdown()
            raise
        self.page = _render(self.sessions, instructions, feedback_ms)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        host = LOOPBACK if self.server_address[0] in ("0.0.0.0", "::") else self.server_address[0]
        return f"http://{host!s}:{self.server_port}/"

    @property
    def table(self) -> Path:
        """Where the choices are."""
        return self.sessions.tables["trials"].path

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function in the thread of the tasks, and return what it returns."""
        return self._worker.submit(function, *arguments).result()

    def server_close(self) -> None:
        """Close the tables, too."""
        super().server_close()
        if hasattr(self, "sessions"):
            self.ask(self.sessions.close)
        self._worker.shutdown()


class _Handler(PageHandler):
    server: HumanServer

    def do_GET(self) -> None:
        """Answer with the page; there are no files."""
        if self.refuses_foreign():
            return
        if self.path.partition("?")[0] != "/":
            self.send_error(404)
            return
        self.answer("text/html", self.server.page, Content_Security_Policy=_POLICY)

    def do_HEAD(self) -> None:
        """Refuse: there are no files."""
        self.send_error(405)

    def do_POST(self) -> None:
        """Let somebody join, or choose."""
        # Pages of other sites cannot send JSON here: browsers would ask us first.
        if self.refuses_foreign():
            return
        if self.headers.get("Content-Type") != "application/json":
            self.send_error(415)
            return
        from scilab_rl.run.human import OtherWindowError

        try:
            status, answer = 200, self._reply()
        except OtherWindowError as error:
            status, answer = 409, {"error": str(error)}
        except ConfigError as error:
            status, answer = 400, {"error": str(error)}
        except ScilabRLError as error:
            _log.error("%s", error)
            status, answer = 500, {"error": str(error)}
        self.answer("application/json", json.dumps(answer), status)

    def _reply(self) -> Any:
        sessions, ask = self.server.sessions, self.server.ask
        try:
            length = int(self.headers.get("Content-Length", ""))
            said = json.loads(self.rfile.read(min(length, _LARGEST)))
            code = str(said["participant"])
            if self.path == "/join":
                call: tuple[Any, ...] = (sessions.join, code)
            else:
                where = (str(said["window"]), int(said["number"]), str(said["key"]))
                call = (sessions.choose, code, *where, str(said["input"]), float(said["rt_ms"]))
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError("The request is not one of this page.") from error
        return ask(*call)


def _render(sessions: HumanSessions, instructions: str | None, feedback_ms: int | None) -> str:
    from markdown_it import MarkdownIt
    from markupsafe import Markup

    from scilab_rl import pages

    if instructions is None:
        shipped = Path(pages.__file__).with_name("templates") / f"human_{sessions.family}.md"
        instructions = shipped.read_text(encoding="utf-8")
    # Tags are shown as text, and pictures, which would need files or the network, left out.
    markdown = MarkdownIt("commonmark", {"html": False}).disable("image")
    if feedback_ms is None:
        feedback_ms = _FEEDBACK_MS.get(sessions.family, 600)
    return pages.render(
        "human.html",
        title=sessions.title,
        instructions=Markup(markdown.render(instructions)),
        settings={"feedback_ms": feedback_ms, "holds": sessions.family == "movement"},
    )


def _read_instructions(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--instructions {path} cannot be read: {error}.") from error


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "human",
        "Serve a page on which people play a task with keys and clicks. Each choice is stored "
        "before the next one; after a reload or a crash, participants continue where they were.",
        base=True,
    )
    add = parser.add_argument
    add("words", nargs="+", metavar="KEY=VALUE", help="env=TASK [env_kwargs.KEY=VALUE] [seed=N]")
    add("--instructions", type=Path, metavar="FILE", help="Markdown; default: those of the task")
    add("--practice", type=int, default=0, metavar="N", help="practice trials; default: none")
    add(
        "--blocks", type=positive, metavar="N", help="blocks, games or episodes; default: 1, 20, 10"
    )
    add("--feedback-ms", type=int, metavar="MS", help="feedback before the next choice; default: "
        "600, and 0 for movements")  # fmt: skip
    add("--output", type=Path, metavar="DIR", help="default: data/human/TASK")
    add("--host", default=LOOPBACK, help="address to listen on; default: 127.0.0.1, this machine")
    add("--port", type=positive, default=8770, help="default: 8770, or the next free")
    add("--no-browser", action="store_true", help="only print where it is")
    options = parser.parse_args(arguments)
    for name in ("practice", "feedback_ms"):
        if (getattr(options, name) or 0) < 0:
            raise ConfigError(f"--{name.replace('_', '-')} must be at least 0.")
    return options
