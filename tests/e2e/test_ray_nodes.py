"""The page on Ray, word for word: two machines, of which one dies. Each is a network namespace."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from scilab_rl.search.runs import COMPLETE

from ..docs.pages import DOCS, blocks_of
from .commands import QUICK, ROOT, TINY, quiet_environment
from .test_hyperopt import runs_of, study_of

pytestmark = pytest.mark.slow
HEAD, NODE = "scilab-head", "scilab-node"
HEAD_ADDRESS, NODE_ADDRESS = "192.0.2.1", "192.0.2.2"


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


def processes_in(machine: str) -> list[int]:
    found = subprocess.run(["ip", "netns", "pids", machine], capture_output=True, text=True)
    return [int(word) for word in found.stdout.split()]


def kill_all(machine: str) -> None:
    for pid in processes_in(machine):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@pytest.fixture
def home() -> Iterator[Path]:
    """A short path, because Ray makes long paths of sockets in it."""
    folder = Path(tempfile.mkdtemp(prefix="ray"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def machines() -> Iterator[None]:
    """Two machines that see each other and nothing else."""
    pytest.importorskip("ray")
    if shutil.which("ip") is None:
        pytest.skip("the program ip is not installed")
    try:
        ip("netns", "add", HEAD)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"network namespaces are not allowed here: {error.stderr.strip()}")
    ip("netns", "add", NODE)
    ip(
        "link",
        "add",
        "sclb0",
        "netns",
        HEAD,
        "type",
        "veth",
        "peer",
        "name",
        "sclb1",
        "netns",
        NODE,
    )
    for machine, link, address in ((HEAD, "sclb0", HEAD_ADDRESS), (NODE, "sclb1", NODE_ADDRESS)):
        ip("-n", machine, "addr", "add", f"{address}/24", "dev", link)
        for device in ("lo", link):
            ip("-n", machine, "link", "set", device, "up")
    yield
    for machine in (HEAD, NODE):
        kill_all(machine)
        ip("netns", "del", machine)


def environment(home: Path) -> dict[str, str]:
    """The installation of the tests, as a user of her own has it."""
    clean = {key: value for key, value in quiet_environment().items() if "RAY" not in key}
    return clean | {
        "HOME": str(home),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "RAY_TMPDIR": str(home),
    }


def type_on(machine: str, script: str, home: Path, **options) -> subprocess.Popen:
    return subprocess.Popen(
        ["ip", "netns", "exec", machine, "bash", "-ec", script], text=True, env=environment(home),
        stderr=subprocess.STDOUT, **options,
    )  # fmt: skip


def test_two_nodes_follow_the_page_and_one_dies(machines: None, home: Path, tmp_path: Path) -> None:
    blocks = [b.text for b in blocks_of(DOCS / "howto" / "ray.md") if b.language == "bash"]
    _, head, node, study = blocks
    for machine, script in ((HEAD, head), (NODE, node)):
        # The background processes of `ray start` keep its output open.
        started = type_on(machine, f"{{ {script} }} > {tmp_path}/{machine} 2>&1", home)
        assert started.wait(120) == 0, (tmp_path / machine).read_text()
    assert (home / ".ray" / "auth_token").stat().st_mode & 0o077 == 0

    short = [
        TINY, *QUICK, "n_epochs=2", "eval_after_n_steps=3000", "require_updates=false",
        "algorithm.learning_starts=100000",  # nothing is learned, so that it takes seconds
        "hydra.sweeper.study_name=two_nodes", "hydra.sweeper.max_trials=4",
        "hydra.sweeper.min_trials_per_param=2", "hydra.sweeper.n_final_runs=1",
        f"hydra.launcher.cpus_per_run={os.cpu_count()}",
    ]  # fmt: skip
    script = study.rstrip().replace("src/main.py", str(ROOT / "src" / "main.py"))
    assert "env=FetchPush " in script
    script = script.replace("env=FetchPush ", "") + " " + " ".join(short)
    process = type_on(HEAD, script, home, cwd=tmp_path, stdout=subprocess.PIPE)
    try:
        wait_for_run_on(NODE, process, tmp_path)
        kill_all(NODE)
        output, _ = process.communicate(timeout=400)
    finally:
        process.kill()
        process.stdout.close()
    assert process.returncode == 0, output
    runs = runs_of(study_of(tmp_path, "two_nodes"))
    assert len(runs) == 4 + 1, "four runs, and one of the winner with a new seed"
    assert {run.state for run in runs} == {COMPLETE}
    assert len({(run.trial, run.repeat) for run in runs}) == 5
    assert sum(run.attempt for run in runs) == 1, "the run of the dead machine, repeated"


def wait_for_run_on(machine: str, study: subprocess.Popen, folder: Path) -> None:
    """Wait until a run trains on a machine, which shows in its directory."""
    deadline = time.monotonic() + 300
    while True:
        assert study.poll() is None, study.communicate()[0]
        assert time.monotonic() < deadline
        for pid in processes_in(machine):
            with contextlib.suppress(psutil.Error):
                files = psutil.Process(pid).open_files()
                if any(file.path.startswith(f"{folder}/data/2") for file in files):
                    return
        time.sleep(0.2)


def test_cluster_with_a_token_says_what_a_machine_without_it_must_do(
    machines: None, home: Path, tmp_path: Path
) -> None:
    head = [b.text for b in blocks_of(DOCS / "howto" / "ray.md") if b.language == "bash"][1]
    assert type_on(HEAD, f"{{ {head} }} > {tmp_path}/head 2>&1", home).wait(120) == 0
    command = (
        f"{sys.executable} {ROOT}/src/main.py {TINY} algorithm=sac seed=1,2 mlflow=0 --multirun "
        f"hydra/launcher=ray hydra.launcher.address={HEAD_ADDRESS}:6379 2>&1 | grep ^error"
    )
    other_home = tmp_path / "other"
    (other_home / ".ray").mkdir(parents=True)
    (other_home / ".ray" / "auth_token").write_text("something else")
    for mode, advice in (("", "export RAY_AUTH_MODE=token"), ("token", "copy ~/.ray/auth_token")):
        script = f"export RAY_AUTH_MODE={mode}; {command}" if mode else command
        process = type_on(NODE, script, other_home, cwd=tmp_path, stdout=subprocess.PIPE)
        output, _ = process.communicate(timeout=120)
        assert advice in output
        assert output.count("\n") == 1


def test_study_of_one_machine_listens_on_the_loopback_and_leaves_no_token(home: Path) -> None:
    pytest.importorskip("ray")
    code = (
        "import psutil\nfrom scilab_rl.parallel.schedulers import RayScheduler\n"
        "ray = RayScheduler()\n"
        "here = psutil.Process()\n"
        "ours = {here.pid, *(child.pid for child in here.children(recursive=True))}\n"
        "for connection in psutil.net_connections():\n"
        "    if connection.status == psutil.CONN_LISTEN and connection.pid in ours:\n"
        "        print(connection.laddr.ip)\n"
        "ray.close()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment(home), capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert {*done.stdout.split()} <= {"127.0.0.1", "::ffff:127.0.0.1", "::1"}
    assert done.stdout
    assert not (home / ".ray").exists()
