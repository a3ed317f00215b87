"""The first thirty minutes of a newcomer, as one test.

A copy of the repository, a virtual environment of its own, no network: the commands and the edit
are those of docs/story.md, in its order. Trainings are shortened, unless ``STORY=full`` asks for
what the page prints, which takes as long as the page says.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

from ..e2e.commands import quiet_environment
from .pages import DOCS, ROOT, Block, blocks_of, insert_after

MOST_COMMANDS, MOST_EDITS, MOST_SECONDS = 7, 1, 30 * 60
FULL = os.environ.get("STORY") == "full"
# What makes each training short, by a word of its command.
SHORT = {
    "make demo": "DEMO='n_epochs=1 eval_after_n_steps=200 n_test_rollouts=1 require_updates=false'",
    "seeds=5": "seeds=3 n_epochs=1 eval_after_n_steps=200 n_test_rollouts=2",
    "choice(": "n_epochs=1 eval_after_n_steps=200 n_test_rollouts=2 hydra.sweeper.max_trials=6",
}
# Looks at what `view` serves, and ends it as a user does.
LOOK = """
import re, signal, subprocess, sys, urllib.request
# Where tests run in the background, Ctrl-C is ignored unless one asks for it.
restore = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
view = subprocess.Popen(sys.argv[1:], stderr=subprocess.PIPE, text=True, preexec_fn=restore)
for line in view.stderr:
    if found := re.search(r"Open (http://\\S+)", line):
        page = urllib.request.urlopen(found[1], timeout=20).read().decode()
        assert "critic_variance" in page
        view.send_signal(signal.SIGINT)
sys.exit(view.wait(30) not in (0, 130))
"""


def has_private_network() -> bool:
    """Return whether this machine lets us cut the network off."""
    command = ["unshare", "-rn", "ip", "link", "set", "lo", "up"]
    if not (shutil.which("unshare") and shutil.which("ip")):
        return False
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


OFFLINE = (
    ["unshare", "-rn", "bash", "-c", 'ip link set lo up && exec "$@"', "bash"]
    if has_private_network()
    else ["env", "http_proxy=http://127.0.0.1:9", "https_proxy=http://127.0.0.1:9"]
)


def story() -> list[Block]:
    return [block for block in blocks_of(DOCS / "story.md") if block.story is not None]


def test_count_of_commands_and_edits() -> None:
    commands = [block for block in story() if block.language == "bash"]
    assert [block.story for block in commands] == [str(n + 1) for n in range(len(commands))]
    assert all(len(block.commands) == 1 for block in commands)
    assert len(commands) <= MOST_COMMANDS
    edits = [block for block in story() if block.language != "bash"]
    assert len(edits) <= MOST_EDITS
    assert all(len(block.text.splitlines()) <= 10 for block in edits)


def test_story(tmp_path: Path) -> None:
    project = clone(tmp_path)
    install(project)
    started = time.monotonic()
    printed: list[str] = []
    seconds: dict[str, float] = {}
    activated = False
    for block in story():
        began = time.monotonic()
        if block.language != "bash":
            path = project / str(block.title)
            line = str(block.story).removeprefix("edit after ")
            path.write_text(insert_after(path.read_text(), line, block.text))
            continue
        (command,) = block.commands
        activated = activated or command.startswith("source ")
        printed.append(type_command(command, project, activated))
        seconds[command.split(" env=")[0]] = round(time.monotonic() - began, 1)
    total = time.monotonic() - started
    sys.stderr.write(f"{len(seconds)} commands, {total:.0f} s: {json.dumps(seconds, indent=1)}\n")
    assert total < MOST_SECONDS
    assert "95 % interval" in printed[0]
    assert list((project / "data").glob("*/*FetchReach*/episodes/play_001.mp4"))
    assert len(list((project / "data").glob("*/*Reach1DOF*my_sac*"))) >= 3
    assert "my_study" in printed[-1] and "cleansac" in printed[-1]


def clone(folder: Path) -> Path:
    """Copy the tracked files of the repository as they are now."""
    project = folder / "scilab-rl"
    listed = subprocess.run(
        ["git", "-c", "safe.directory=*", "ls-files", "-z"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name in filter(None, listed.stdout.split("\0")):
        (project / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, project / name)
    return project


def install(project: Path) -> None:
    """Do what ``make setup`` does, with the packages of the running environment."""
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", str(project / ".venv")], check=True
    )
    (site,) = (project / ".venv").glob("lib/python*/site-packages")
    (site / "outer.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    pip = [sys.executable, "-m", "pip", "--python", str(project / ".venv" / "bin" / "python")]
    offline = ["--no-deps", "--no-index", "--no-build-isolation", "--quiet"]
    subprocess.run([*pip, "install", *offline, "-e", str(project)], check=True, cwd=project)
    (project / ".venv" / ".installed").touch()


def type_command(command: str, project: Path, activated: bool) -> str:
    """Type a line into a shell without network and return what it printed."""
    if not FULL:
        command = " ".join([command, *(more for word, more in SHORT.items() if word in command)])
    if "scilab-rl view" in command:
        (project / "look.py").write_text(LOOK)
        command = f"python look.py {command}"
    prefix = "source .venv/bin/activate && " if activated else ""
    done = subprocess.run(
        [*OFFLINE, "bash", "-c", prefix + command],
        cwd=project, env=quiet_environment(DISPLAY=""), capture_output=True, text=True,
        timeout=MOST_SECONDS, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    assert not re.search(r"Traceback|Warning", done.stderr), f"{command}\n{done.stderr[-3000:]}"
    return done.stdout
