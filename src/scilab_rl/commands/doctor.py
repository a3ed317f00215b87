"""``scilab-rl doctor [env=ID ...]``: check the installation, or an environment."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

from scilab_rl.commands.parser import CommandParser, positive
from scilab_rl.commands.tables import print_json, print_rows, write
from scilab_rl.errors import RenderingError, ScilabRLError
from scilab_rl.findings import FAIL, INFO, OK, WARN, Finding
from scilab_rl.visualization import gl

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
# Extra -> the module that it brings.
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
        "Check the installation, or with env=ID an environment, and say how to repair it.",
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="env=ID",
        help="an environment, with env_kwargs and wrappers",
    )
    parser.add_argument("--steps", type=positive, default=1000, help="random steps in it (1000)")
    parser.add_argument("--rendering-hint", action="store_true", help="check only the pictures")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)
    if options.rendering_hint:
        _print_rendering_hint()
        return 0

    if options.overrides:
        from scilab_rl.commands import doctor_env

        findings = doctor_env.examine(options.overrides, options.steps)
    else:
        findings = list(examine())
    if options.json:
        print_json([asdict(finding) for finding in findings])
    else:
        rows = [asdict(finding) for finding in findings]
        print_rows(("check", "result", "found", "fix"), rows)
    return int(any(finding.result == FAIL for finding in findings))


def examine() -> Iterator[Finding]:
    """Yield what all checks find; a check that itself breaks is a finding too."""
    checks: tuple[Callable[[], Iterable[Finding]], ...] = (
        check_python,
        check_versions,
        check_fingerprint,
        check_rendering,
        check_ffmpeg,
        check_desk,
        check_disk,
        check_device,
        check_extras,
    )
    for check in checks:
        try:
            yield from check()
        except Exception as error:  # noqa: BLE001 - a broken installation may raise anything
            name = check.__name__.removeprefix("check_")
            yield Finding(name, FAIL, f"{type(error).__name__}: {error}", _PINNED)


def check_python() -> Iterator[Finding]:
    """Check the interpreter."""
    found = f"{platform.python_version()} in {sys.prefix}"
    good = sys.version_info >= (3, 10)
    yield Finding("python", OK if good else FAIL, found, None if good else "install 3.10 or newer")


def check_versions() -> Iterator[Finding]:
    """Compare the core packages with the versions that we declare to work."""
    from packaging.requirements import Requirement

    declared = [Requirement(line) for line in metadata.requires("scilab-rl") or ()]
    default = ("None", 'extra == "robotics"')
    tested = {need.name: need.specifier for need in declared if str(need.marker) in default}
    for name in CORE:
        wanted = tested[name]
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield Finding(name, FAIL, "not installed", _PINNED)
            continue
        if version in wanted:
            yield Finding(name, OK, version)
        else:
            found = f"{version}, tested are {wanted}"
            yield Finding(name, WARN, found, f'pip install "{name}{wanted}"')


def check_fingerprint() -> Iterator[Finding]:
    """Check that the Fetch robot still moves as it did when results were measured."""
    import gymnasium as gym

    from scilab_rl.envs.fingerprint import fingerprint
    from scilab_rl.envs.registration import resolve_env_id

    env_id, _ = resolve_env_id("FetchReach-v4")
    env = gym.make(env_id)
    found, mujoco = fingerprint(env), metadata.version("mujoco")
    env.close()
    check = f"{env_id} fingerprint"
    if found in KNOWN_FINGERPRINTS:
        yield Finding(check, OK, f"{found}, as with mujoco {KNOWN_FINGERPRINTS[found]}")
    elif mujoco == REFERENCE_MUJOCO:
        fix = "compare results of this machine among themselves only"
        yield Finding(check, WARN, f"{found}: another processor than ours?", fix)
    else:
        fix = f"pip install mujoco=={REFERENCE_MUJOCO}"
        yield Finding(check, FAIL, f"{found} is unknown: mujoco {mujoco} moves differently", fix)


def check_rendering() -> Iterator[Finding]:
    """Try each OpenGL back end in a process of its own."""
    with ThreadPoolExecutor(len(gl.BACKENDS)) as pool:
        problems = dict(zip(gl.BACKENDS, pool.map(gl.probe, gl.BACKENDS), strict=True))
    any_works = None in problems.values()
    for backend, problem in problems.items():
        if problem is None:
            yield Finding(f"rendering with {backend}", OK, "draws")
        elif any_works:
            yield Finding(f"rendering with {backend}", INFO, f"{problem}; another one draws")
        else:
            yield Finding(f"rendering with {backend}", WARN, problem, f"sudo {gl.APT_LINE}")


def check_ffmpeg() -> Iterator[Finding]:
    """Run the program that encodes videos."""
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
        subprocess.run([program, "-version"], capture_output=True, timeout=20, check=True)
    except (RuntimeError, OSError, subprocess.SubprocessError) as error:
        fix = "pip install --force-reinstall imageio-ffmpeg, or set IMAGEIO_FFMPEG_EXE"
        yield Finding("ffmpeg", WARN, f"no videos: {error}", fix)
    else:
        yield Finding("ffmpeg", OK, Path(program).name)


def check_desk() -> Iterator[Finding]:
    """Import the researcher's own environments and algorithms."""
    from scilab_rl.commands.algorithms import describe_all
    from scilab_rl.workspace import open_desk

    try:
        open_desk()
    except ScilabRLError as error:
        yield Finding("desk", FAIL, str(error), "repair or move the file")
        return
    rows = describe_all()
    for row in rows:
        if row["problem"]:
            yield Finding(f"algorithm={row['algorithm']}", WARN, row["problem"], "repair the file")
    usable = sum(row["problem"] is None for row in rows)
    n_own = sum(row["where"] == "desk" for row in rows)
    yield Finding("desk", OK, f"{usable} usable algorithms; {n_own} of all are your own")


def check_disk() -> Iterator[Finding]:
    """Check the space and the permission where runs are written by default."""
    folder = Path("data") if Path("data").is_dir() else Path.cwd()
    free = shutil.disk_usage(folder).free
    found = f"{free / 2**30:.1f} GiB free in {folder.resolve()}"
    if not os.access(folder, os.W_OK):
        yield Finding("disk", FAIL, f"{folder} is not writable", "base_logdir=ANOTHER_FOLDER")
    elif free < _LITTLE_SPACE_BYTES:
        result = FAIL if free < _NO_SPACE_BYTES else WARN
        yield Finding("disk", result, found, "delete old runs, or base_logdir=ANOTHER_FOLDER")
    else:
        yield Finding("disk", OK, found)


def check_device() -> Iterator[Finding]:
    """Say what PyTorch computes on with ``device=auto``."""
    import torch

    if torch.cuda.is_available():
        yield Finding("device", OK, f"GPU {torch.cuda.get_device_name()}")
    else:
        yield Finding("device", OK, f"CPU with {os.cpu_count()} cores; no CUDA GPU")


def check_extras() -> Iterator[Finding]:
    """List the optional parts."""
    for extra, module in EXTRAS.items():
        if importlib.util.find_spec(module) is None:
            install = f'pip install "scilab-rl[{extra}]"'
            yield Finding(f"extra {extra}", INFO, "not installed", install)
        else:
            yield Finding(f"extra {extra}", OK, "installed")


def _print_rendering_hint() -> None:
    """Print how to get pictures, where there are none, and nothing where there are."""
    try:
        gl.choose_backend()
    except RenderingError:
        write("Training works without pictures. For pictures on Debian or Ubuntu:")
        write(f"sudo {gl.APT_LINE}")
        sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
