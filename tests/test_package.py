"""The package as a whole: imports one way, a light start, small files, a wheel that works by itself."""

import ast
import functools
import graphlib
import os
import re
import shutil
import site
import subprocess
import sys
import venv
import zipfile
from collections import Counter
from pathlib import Path

import pytest
import yaml
from testing.models import hand_made_model
from testing.projects import project_of

import pisigma
from pisigma.files.errors import EXTRAS
from pisigma.model.folder.model_folder import save_model

ROOMS = (
    "files",
    "robot",
    "estimation",
    "measurement",
    "network",
    "joint_correction",
    "simulation",
    "calibration",
    "model",
    "validation",
    "planning",
    "lifetime",
    "deployment",
    "reporting",
    "workflow",
    "workbench",
    "cli",
)
"""A file imports only from its room and those before it; CONTRIBUTING.md describes them."""

PACKAGE = Path(pisigma.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
TESTS = Path(__file__).parent
MAX_WHEEL = 2 * 2**20
"""Largest size of the wheel [byte]."""
MAX_LINES, MAX_FILES = 400, 20
"""Maximum length of a file, and number of files in a folder."""


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


@functools.cache
def imported(path: Path) -> frozenset[str]:
    """Return the modules that a file imports anywhere, including inside functions and for type checkers."""
    found: set[str] = set()
    nodes: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while nodes:
        node = nodes.pop()
        nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)}: relative import"
            assert node.module is not None
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def test_the_package_contains_only_the_listed_packages():
    tops = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in MODULES}
    assert tops == {"__init__", "__main__", *ROOMS}


def test_contributing_describes_every_room():
    """One line per room, in the order of imports."""
    text = (TESTS.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert re.findall(r"^- `(\w+)/` \S.*\.$", text, re.MULTILINE) == list(ROOMS)


def test_imports_run_one_way():
    upwards = []
    for path in MODULES:
        room = path.relative_to(PACKAGE).parts[0]
        for module in imported(path) if room in ROOMS else ():
            _, other, *_ = (*module.split("."), "")
            if module.startswith("pisigma.") and other in ROOMS[ROOMS.index(room) + 1 :]:
                upwards.append(f"{name_of(path)} imports {module}, which stands below it")
    assert not upwards


def test_no_two_files_import_each_other():
    """There are no import cycles of any length, including imports inside functions and those for types."""
    files = {
        ".".join(("pisigma", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
            ".__init__"
        ): path
        for path in MODULES
    }
    graph = {
        name_of(path): {name_of(files[module]) for module in imported(path) & set(files)} - {name_of(path)}
        for path in files.values()
    }
    graphlib.TopologicalSorter(graph).prepare()  # CycleError names the circle


def test_lightning_is_imported_in_training_only():
    users = {
        path.relative_to(PACKAGE).parts[0]
        for path in MODULES
        if {module.split(".")[0] for module in imported(path)} & {"lightning", "pytorch_lightning"}
    }
    assert users <= {"network"}


def test_files_and_folders_are_small():
    lines = {name_of(path): path.read_text(encoding="utf-8").count("\n") for path in MODULES}
    assert not {name for name, count in lines.items() if count > MAX_LINES}
    folders = Counter(name_of(path.parent) for path in MODULES)
    assert not {folder: count for folder, count in folders.items() if count > MAX_FILES}


def test_no_catch_all_modules():
    assert not {path.stem for path in MODULES} & {"utils", "util", "helpers", "common", "misc"}


def test_import_is_light_and_has_no_side_effects(tmp_path):
    script = (
        "import sys, warnings, random\n"
        "filters, state = list(warnings.filters), random.getstate()\n"
        "import pisigma\n"
        "heavy = ('torch', 'numpy', 'lightning', 'matplotlib', 'scipy', 'yaml', 'typer', 'rich')\n"
        "assert not [name for name in heavy if name in sys.modules], sys.modules.keys() & set(heavy)\n"
        "assert warnings.filters == filters and random.getstate() == state\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", sorted((PACKAGE / "robot" / "kernels").glob("*.py")), ids=name_of)
def test_the_compiled_route_imports_no_torch(path):
    if path.name == "array_kinematics.py":  # which sends tensors to torch; see its own test
        return
    light = {
        "files",
        "files.errors",
        "robot.kinematics.status",
        "robot.kinematics.tolerances",
        "robot.kernels",
    }
    if path.name == "forms.py":  # which asks for closed forms where kernels are made, see tests/kernels
        light.add("robot.kinematics.closed_form.registry")
    own = {module.removeprefix("pisigma.") for module in imported(path) if module.startswith("pisigma.")}
    own -= {
        "robot",
        "robot.kinematics",
    }  # of `from pisigma.robot.kinematics import tolerances`: a package without code
    assert not {module for module in own if not module.startswith(tuple(light))}
    assert not {module.split(".")[0] for module in imported(path)} & {"torch", "scipy", "jaxtyping"}


def test_loading_a_model_needs_neither_lightning_nor_matplotlib():
    script = (
        "import sys\nimport pisigma\npisigma.load\npisigma.CorrectedIK\n"
        "assert not [name for name in ('lightning', 'matplotlib', 'scipy', 'pisigma.network') if name in "
        "sys.modules]\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", pisigma.__all__)
def test_public_names_are_there_and_documented(name):
    value = getattr(pisigma, name)
    assert value.__name__ == name
    assert value.__doc__
    assert name in dir(pisigma)


def test_type_checkers_find_the_public_names():
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    named = [alias.asname for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert sorted(map(str, named)) == pisigma.__all__


def test_unknown_names_are_no_attributes():
    assert sorted(pisigma.__all__) == list(pisigma.__all__)
    with pytest.raises(AttributeError, match="no attribute 'laod'"):
        _ = pisigma.laod


def test_version_is_that_of_the_project(repository):
    project = project_of(repository)
    assert pisigma.__version__ == project["version"]


def test_published_metadata_agree(repository):
    """Version and licence agree in pyproject.toml and CITATION.cff, and extras named in messages exist."""
    project = project_of(repository)
    citation = yaml.safe_load((repository / "CITATION.cff").read_text())
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    for package, extra in EXTRAS.items():
        assert any(wanted.startswith(package) for wanted in project["optional-dependencies"][extra])
        assert not any(wanted.startswith(package) for wanted in project["dependencies"])
    recipe = yaml.safe_load((repository / "packaging" / "conda" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == project["version"]
    conda = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
    required = [re.split(r"(?=[<>=])", one, maxsplit=1) for one in project["dependencies"]]
    assert recipe["requirements"]["run"] == [
        "python >=3.10",
        *(f"{conda.get(name, name)} {limits}" for name, limits in required),
    ]
    hooks = yaml.safe_load((repository / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert [hook["entry"].split()[0] for hook in hooks] == ["ruff", "ruff", "mypy"]


def test_tests_compare_numbers_with_one_helper():
    """A bare allclose asserts nothing, and some of them pass NaN."""
    for path in TESTS.rglob("*.py"):
        calls = {
            node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Call)
        }
        assert path.name == "closeness.py" or not calls & {"allclose", "isclose", "assert_allclose"}, path


def test_no_absolute_paths_are_shipped(repository):
    """Shipped files contain no absolute path of a machine."""
    pattern = re.compile(r"(?<![\w.])/(home|root|work|tmp|Users)/")
    suffixes = {".py", ".md", ".yaml", ".toml", ".txt"}
    folders = ("pisigma", "training", "models")
    found = [
        path
        for folder in folders
        for path in (repository / folder).rglob("*")
        if path.suffix in suffixes and pattern.search(path.read_text(encoding="utf-8"))
    ]
    assert not found


@pytest.fixture(scope="module")
def wheel(repository, tmp_path_factory) -> Path:
    """The built wheel."""
    out = tmp_path_factory.mktemp("dist")
    command = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(out),
        str(repository),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (found,) = out.glob("*.whl")
    return found


def test_the_wheel_contains_only_the_package_and_is_small(wheel):
    assert wheel.stat().st_size <= MAX_WHEEL
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"pisigma", f"pisigma-{pisigma.__version__}.dist-info"}
    shipped = {name for name in names if name.startswith("pisigma/")}
    there = {
        f"pisigma/{path.relative_to(PACKAGE).as_posix()}"
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert shipped == there
    assert {"pisigma/py.typed", "pisigma/robot/catalogue/kiro3.yaml", "pisigma/cli/main.py"} <= shipped


def test_the_wheel_shows_a_readme_whose_links_and_pictures_work(wheel, repository):
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
    shown = archive.read(name).decode().partition("\n\n")[2]
    readme = (repository / "README.md").read_text()
    assert shown.startswith("# pisigma\n")
    assert len(shown) > 0.8 * len(readme)
    assert not re.findall(r"!\[|<!--", shown)
    assert not [
        link for link in re.findall(r"\]\(([^)]+)\)", shown) if not link.startswith(("https://", "#"))
    ]
    assert re.findall(r"^```.*?^```", shown, re.M | re.S) == re.findall(r"^```.*?^```", readme, re.M | re.S)


def test_the_wheel_works_without_lightning(wheel, tmp_path):
    """It is installed into a fresh environment with the dependencies, but without lightning and the checkout."""
    folder = tmp_path / "environment"
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(python),
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
    ]
    installed = subprocess.run([*pip, str(wheel)], capture_output=True, text=True, check=False)
    assert installed.returncode == 0, installed.stderr
    (target,) = folder.glob("lib/python*/site-packages")
    dependencies = [path for path in (*site.getsitepackages(), *sys.path) if path.endswith("site-packages")]
    (target / "dependencies.pth").write_text("\n".join(dict.fromkeys(dependencies)) + "\n")
    model = tmp_path / "model"
    model.mkdir()
    save_model(hand_made_model("kiro4"), model)
    script = (
        "import sys\n"
        "sys.modules['lightning'] = sys.modules['pytorch_lightning'] = None  # importing them fails\n"
        "import numpy as np, pisigma\n"
        "assert pisigma.__file__.startswith(sys.argv[1]), pisigma.__file__\n"
        "T = np.eye(4)\nT[:3, 3] = 0.7, 0.1, 0.6\n"
        "solution = pisigma.load(sys.argv[2])(T)\n"
        "print(tuple(solution.q.shape), pisigma.Robot.load('kiro3').name)\n"
    )
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment["XDG_CACHE_HOME"] = str(_compiled_kernels(tmp_path))

    def output(*command: str | Path) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert output(python, "-c", script, str(target), str(model)) == "(6,) kiro3\n"
    assert output(folder / "bin" / "pisigma", "--version") == f"pisigma {pisigma.__version__}\n"
    assert output(python, "-m", "pisigma", "--version") == f"pisigma {pisigma.__version__}\n"


def _compiled_kernels(folder):
    """Return a cache folder with the compiled kernels of this checkout, which are those of its wheel."""
    kept = folder / "caches" / "pisigma"
    kept.mkdir(parents=True)
    for path in Path(pisigma.__file__).parent.glob("robot/kernels/__pycache__/*.o"):
        shutil.copy(path, kept)
    return kept.parent
