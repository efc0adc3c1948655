"""`pisigma-ik`, built from packaging/pisigma-ik: corrected inverse kinematics in an environment without torch."""

import json
import os
import subprocess
import sys
import venv
import zipfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from testing.projects import project_of
from testing.serving import client

import pisigma
from pisigma.robot.kernels.machine_code import cache_folders

MAX_INSTALLED = 260e6
"""Largest size of the package with its dependencies [byte]."""
POSE = ["800", "200", "600", "10", "-80", "170"]


def required(distributions: list[Requirement]) -> dict[str, Distribution]:
    """Return the distributions of requirements and of what they require."""
    found: dict[str, Distribution] = {}
    wanted = list(distributions)
    while wanted:
        one = wanted.pop()
        if one.name not in found and (one.marker is None or one.marker.evaluate({"extra": ""})):
            found[one.name] = distribution(one.name)
            wanted += map(Requirement, found[one.name].requires or ())
    return found


@pytest.fixture(scope="module")
def wheel(repository, tmp_path_factory) -> Path:
    """The built wheel."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out)]
    done = subprocess.run(
        [*command, str(repository / "packaging" / "pisigma-ik")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (found,) = out.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def dependencies(repository) -> dict[str, Distribution]:
    """Distributions that the wheel requires, as installed here."""
    project = project_of(repository / "packaging" / "pisigma-ik")
    return required([Requirement(one) for one in project["dependencies"]])


@pytest.fixture(scope="module")
def environment(wheel, dependencies, tmp_path_factory) -> Path:
    """A fresh environment with the wheel and links to its dependencies, and nothing else."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=True)
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python")]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True)
    (target,) = folder.glob("lib/python*/site-packages")
    for one in dependencies.values():
        for name in {path.parts[0] for path in one.files or ()} - {"..", "__pycache__"}:
            (target / name).symlink_to(one.locate_file(name))
    kernels = folder / "cache" / "pisigma"
    kernels.mkdir(parents=True)
    for path in cache_folders()[0].glob("*.o"):  # of this checkout, which are those of its wheel
        (kernels / path.name).write_bytes(path.read_bytes())
    return folder


def run_in(environment: Path, *command: str | Path) -> subprocess.CompletedProcess:
    """Run a command of the environment outside of the checkout."""
    return subprocess.run(
        [environment / "bin" / command[0], *command[1:]],
        cwd=environment,
        env=variables(environment),
        capture_output=True,
        text=True,
        check=False,
    )


def variables(environment: Path) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return {**kept, "XDG_CACHE_HOME": str(environment / "cache")}


def test_it_contains_the_modules_of_pisigma(wheel):
    package = Path(pisigma.__file__).parent
    there = {path for path in package.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    names = zipfile.ZipFile(wheel).namelist()
    assert {name for name in names if name.startswith("pisigma/")} == {
        f"pisigma/{path.relative_to(package).as_posix()}" for path in there
    }


def test_its_dependencies_are_those_of_pisigma_and_small(wheel, dependencies, repository):
    projects = [project_of(folder) for folder in (repository, repository / "packaging" / "pisigma-ik")]
    assert set(projects[1]["dependencies"]) <= set(projects[0]["dependencies"])
    assert "torch" not in dependencies
    size = sum(one.file_size for one in zipfile.ZipFile(wheel).infolist())
    for one in dependencies.values():
        paths = (Path(str(one.locate_file(path))) for path in one.files or () if path.suffix != ".pyc")
        size += sum(path.stat().st_size for path in paths if path.is_file())
    assert size < MAX_INSTALLED


def test_joint_values_are_those_of_the_full_package_to_the_bit(environment, repository):
    """Poses of training rows, solved by both."""
    program = """
import sys
import numpy as np
import pisigma
assert pisigma.__file__.startswith(sys.argv[1]), pisigma.__file__
found = pisigma.load(sys.argv[2])(np.load(sys.argv[3]), throw=False)
np.savez(sys.argv[4], q=found.q, status=found.status)
"""
    model = repository / "models" / "kiro4"
    ik = pisigma.load(model)
    T = ik.model.forward(ik.model.starts[:20]).detach().numpy()
    np.save(environment / "poses.npy", T)
    done = run_in(
        environment, "python", "-c", program, environment, model, environment / "poses.npy", "found.npz"
    )
    assert done.returncode == 0, done.stderr
    found, expected = np.load(environment / "found.npz"), ik(T, throw=False)
    assert np.array_equal(found["q"], np.asarray(expected.q), equal_nan=True)
    assert np.array_equal(found["status"], np.asarray(expected.status))
    assert (found["status"] == pisigma.Status.REACHED).sum() > 5


def test_its_commands_solve_and_serve(environment, repository):
    model = repository / "models" / "kiro4"
    done = run_in(environment, "pisigma", "ik", model, "--pose", *POSE, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["solutions"][0]["status"] == "reached"
    with subprocess.Popen(
        [environment / "bin" / "pisigma", "serve", model],
        stdout=subprocess.PIPE,
        text=True,
        env=variables(environment),
    ) as process:
        lines = client.JsonClient(json.loads(process.stdout.readline())["json_port"])
        assert lines.ask(pose=list(map(float, POSE)))["status"] == "reached"
        lines.close()
        process.terminate()
        assert process.wait(10) == 0


def test_a_command_that_needs_torch_says_so(environment, repository, tmp_path):
    done = run_in(
        environment,
        "pisigma",
        "export",
        repository / "models" / "kiro4",
        "--out",
        tmp_path / "x",
        "--format",
        "urdf",
    )
    assert done.returncode == 2
    assert "torch" in done.stderr
    assert "pip install pisigma" in done.stderr
