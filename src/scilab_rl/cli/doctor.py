"""``scilab-rl doctor [env=ID ...]``: check the installation, or an environment."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

from scilab_rl.check_results import FAIL, INFO, OK, WARN, CheckResult
from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.tables import print_rows, write
from scilab_rl.errors import RenderingError, ScilabRLError
from scilab_rl.recording import gl

_log = logging.getLogger(__name__)
# The fingerprints of FetchReach-v4 with gymnasium-robotics 1.4.2, and the versions of MuJoCo that
# were found to give them: 3.3.0, 3.3.2, 3.3.7, 3.4.0, 3.5.0, 3.6.0. With 3.7.0 it is another one.
KNOWN_FINGERPRINTS = {
    "e31e8f69af094d75": "3.3.0",
    "54a0c22ef6c6dec6": "3.3.2 to 3.6.0",
}
REFERENCE_MUJOCO = "3.3.0"
CORE = (
    "mujoco", "gymnasium", "gymnasium-robotics", "stable-baselines3", "sb3-contrib", "torch",
    "numpy", "hydra-core", "omegaconf",
)  # fmt: skip
# Extra -> a module that it installs.
EXTRAS = {
    "mlflow": "mlflow",
    "wandb": "wandb",
    "tensorboard": "tensorboard",
    "view": "rerun",
    "jax": "jax",
    "ray": "ray",
    "slurm": "submitit",
    "metaworld": "metaworld",
    "highway": "highway_env",
    "myosuite": "myosuite",
    "panda": "panda_gym",
    "coppeliasim": "coppeliasim_zmqremoteapi_client",
}
_PINNED = "pip install -c constraints.txt -e ."
# A run keeps a few policies and checkpoints; a full replay buffer of images is far larger.
_LITTLE_SPACE_BYTES, _NO_SPACE_BYTES = 5 * 2**30, 2**28


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code: 0 when nothing fails, else 1."""
    parser = CommandParser(
        "doctor",
        "Check the installation, or with env=ID an environment, and how to repair it.",
        json=True,
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="env=ID",
        help="an environment, with env_kwargs and wrappers",
    )
    parser.add_argument("--steps", type=positive, default=1000, help="random steps in it (1000)")
    parser.add_argument("--rendering-hint", action="store_true", help="check only the pictures")
    options = parser.parse_args(arguments)
    if options.rendering_hint:
        _print_rendering_hint()
        return 0

    if options.overrides:
        results = list(check_task(options.overrides, options.steps))
    else:
        results = list(check_installation())
    rows = [asdict(result) for result in results]
    print_rows(("check", "result", "found", "fix"), rows, as_json=options.json)
    return int(any(result.result == FAIL for result in results))


def check_task(overrides: Sequence[str], n_steps: int) -> Iterator[CheckResult]:
    """Check the environment of a command line, with its arguments and wrappers.

    Args:
        overrides: For example ``env=FetchReach`` and ``env_kwargs.reward_type=dense``.
        n_steps: Random steps on which rewards are compared.

    Raises:
        ConfigError: If there is no such environment.
    """
    from scilab_rl.config.compose import compose
    from scilab_rl.config.workspace import open_project
    from scilab_rl.envs import checker, fingerprint
    from scilab_rl.envs.vectorize import make_single_env
    from scilab_rl.recording.gl import choose_backend
    from scilab_rl.run.checks import complete

    with contextlib.suppress(RenderingError):  # the check of pictures says it
        choose_backend()  # before the environment imports MuJoCo
    open_project()
    cfg = complete(compose(["tuned=false", *overrides]))
    known = () if cfg.env_kwargs or cfg.wrappers else fingerprint.known(cfg.env)
    _log.info("Checking %s with %d random steps.", cfg.env, n_steps)
    yield from checker.check_environment(
        lambda: make_single_env(cfg),
        n_steps=n_steps,
        known_fingerprints=known,
        make_drawn=lambda: make_single_env(cfg, "rgb_array"),
    )


def check_installation() -> Iterator[CheckResult]:
    """Yield the results of all checks; a check that raises is a failure."""
    checks: tuple[Callable[[], Iterable[CheckResult]], ...] = (
        check_python,
        check_versions,
        check_fingerprint,
        check_rendering,
        check_ffmpeg,
        check_project,
        check_disk,
        check_device,
        check_extras,
    )
    for check in checks:
        try:
            yield from check()
        except Exception as error:  # noqa: BLE001 - a broken installation may raise anything
            name = check.__name__.removeprefix("check_")
            yield CheckResult(name, FAIL, f"{type(error).__name__}: {error}", _PINNED)


def check_python() -> Iterator[CheckResult]:
    """Check the interpreter."""
    found = f"{platform.python_version()} in {sys.prefix}"
    good = sys.version_info >= (3, 10)
    yield CheckResult(
        "python", OK if good else FAIL, found, None if good else "install 3.10 or newer"
    )


def check_versions() -> Iterator[CheckResult]:
    """Compare the versions of the core packages with the declared ones."""
    from packaging.requirements import Requirement

    declared = [Requirement(line) for line in metadata.requires("scilab-rl") or ()]
    default = ("None", 'extra == "robotics"')
    tested = {need.name: need.specifier for need in declared if str(need.marker) in default}
    for name in CORE:
        declared_versions = tested[name]
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield CheckResult(name, FAIL, "not installed", _PINNED)
            continue
        if version in declared_versions:
            yield CheckResult(name, OK, version)
        else:
            found = f"{version}, tested: {declared_versions}"
            yield CheckResult(name, WARN, found, f'pip install "{name}{declared_versions}"')


def check_fingerprint() -> Iterator[CheckResult]:
    """Check that the simulated Fetch robot moves as it did for the published results."""
    import gymnasium as gym

    from scilab_rl.envs.fingerprint import fingerprint
    from scilab_rl.envs.registration import resolve_env_id

    env_id, _ = resolve_env_id("FetchReach-v4")
    env = gym.make(env_id)
    found, mujoco = fingerprint(env), metadata.version("mujoco")
    env.close()
    check = f"{env_id} fingerprint"
    if found in KNOWN_FINGERPRINTS:
        yield CheckResult(check, OK, f"{found}, as with mujoco {KNOWN_FINGERPRINTS[found]}")
    elif mujoco == REFERENCE_MUJOCO:
        fix = "compare results of this machine only with each other"
        yield CheckResult(check, WARN, f"{found}: probably another type of processor", fix)
    else:
        fix = f"pip install mujoco=={REFERENCE_MUJOCO}"
        yield CheckResult(
            check, FAIL, f"{found} is unknown: mujoco {mujoco} moves differently", fix
        )


def check_rendering() -> Iterator[CheckResult]:
    """Try each OpenGL back end in a process of its own."""
    with ThreadPoolExecutor(len(gl.BACKENDS)) as pool:
        problems = dict(zip(gl.BACKENDS, pool.map(gl.probe, gl.BACKENDS), strict=True))
    any_works = None in problems.values()
    for backend, problem in problems.items():
        if problem is None:
            yield CheckResult(f"rendering with {backend}", OK, "draws")
        elif any_works:
            yield CheckResult(f"rendering with {backend}", INFO, f"{problem}; another one draws")
        else:
            yield CheckResult(f"rendering with {backend}", WARN, problem, f"sudo {gl.APT_LINE}")


def check_ffmpeg() -> Iterator[CheckResult]:
    """Run the program that encodes videos."""
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
        subprocess.run([program, "-version"], capture_output=True, timeout=20, check=True)
    except (RuntimeError, OSError, subprocess.SubprocessError) as error:
        fix = "pip install --force-reinstall imageio-ffmpeg, or set IMAGEIO_FFMPEG_EXE"
        yield CheckResult("ffmpeg", WARN, f"no videos: {error}", fix)
    else:
        yield CheckResult("ffmpeg", OK, Path(program).name)


def check_project() -> Iterator[CheckResult]:
    """Import the researcher's own environments and algorithms."""
    from scilab_rl.cli.algorithms import describe_all
    from scilab_rl.config.workspace import open_project

    try:
        open_project()
    except ScilabRLError as error:
        yield CheckResult("project", FAIL, str(error), "repair or move the file")
        return
    rows = describe_all()
    for row in rows:
        if row["problem"]:
            yield CheckResult(
                f"algorithm={row['algorithm']}", WARN, str(row["problem"]), "repair the file"
            )
    usable = sum(row["problem"] is None for row in rows)
    n_own = sum(row["where"] == "project" for row in rows)
    yield CheckResult("project", OK, f"{usable} usable algorithms; {n_own} of all are your own")


def check_disk() -> Iterator[CheckResult]:
    """Check the space and the permission where runs are written by default."""
    folder = Path("data") if Path("data").is_dir() else Path.cwd()
    free = shutil.disk_usage(folder).free
    found = f"{free / 2**30:.1f} GiB free in {folder.resolve()}"
    if not os.access(folder, os.W_OK):
        yield CheckResult("disk", FAIL, f"{folder} is not writable", "base_logdir=ANOTHER_FOLDER")
    elif free < _LITTLE_SPACE_BYTES:
        result = FAIL if free < _NO_SPACE_BYTES else WARN
        yield CheckResult("disk", result, found, "delete old runs, or base_logdir=ANOTHER_FOLDER")
    else:
        yield CheckResult("disk", OK, found)


def check_device() -> Iterator[CheckResult]:
    """Report the device of PyTorch with ``device=auto``."""
    import torch

    if torch.cuda.is_available():
        yield CheckResult("device", OK, f"GPU {torch.cuda.get_device_name()}")
    else:
        yield CheckResult("device", OK, f"CPU with {os.cpu_count()} cores; no CUDA GPU")


def check_extras() -> Iterator[CheckResult]:
    """List the optional packages."""
    for extra, module in EXTRAS.items():
        if importlib.util.find_spec(module) is None:
            install = f'pip install "scilab-rl[{extra}]"'
            yield CheckResult(f"extra {extra}", INFO, "not installed", install)
        else:
            yield CheckResult(f"extra {extra}", OK, "installed")


def _print_rendering_hint() -> None:
    """Print how to enable rendering if it does not work."""
    try:
        gl.choose_backend()
    except RenderingError:
        write("Training works without pictures. For pictures on Debian or Ubuntu:")
        write(f"sudo {gl.APT_LINE}")
        sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
