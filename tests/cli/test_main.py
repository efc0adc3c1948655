"""The command itself: quick, with the agreed exit status, JSON and nothing else on stdout."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from testing.models import small_recipe_text
from testing.refusals import problem_of

import pisigma
from pisigma.cli.endings import TRACEBACK
from pisigma.cli.output import print_lines, print_table
from pisigma.files.errors import OutputError
from pisigma.robot import Robot, catalogue
from pisigma.robot.writing import robot_to_yaml

HEAVY = ("torch", "numpy", "yaml", "lightning", "matplotlib", "scipy", "rich.table")
START = "import sys; sys.argv = ['pisigma', *sys.argv[1:]]; from pisigma.cli.main import run; run()"


def command(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", START, *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["train", "--help"], ["ik", "--help"]])
def test_help_imports_nothing_heavy(arguments):
    script = (
        "import sys\n"
        "from pisigma.cli.main import run\n"
        f"sys.argv = ['pisigma', *{arguments!r}]\n"
        "try:\n    run()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        f"print('heavy:', [name for name in {HEAVY!r} if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("heavy: []\n")


@pytest.mark.parametrize("name", ["robots", "simulate", "train", "evaluate", "ik", "export"])
def test_every_command_explains_itself(run, name):
    result = run(name, "--help")
    assert result.exit_code == 0
    assert "--json" in result.stdout
    assert name in run("--help").stdout


def test_version(run):
    assert run("--version").stdout == f"pisigma {pisigma.__version__}\n"


@pytest.mark.parametrize(
    "arguments", [["trian"], ["robots", "--colour"], ["evaluate"], ["train"], ["simulate", "x.yaml"]]
)
def test_usage_errors_exit_2(run, arguments):
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "Traceback" not in result.stderr


def test_robots(run):
    listed = run("robots")
    printed = json.loads(run("robots", "--json").stdout)
    assert [robot["name"] for robot in printed["robots"]] == list(catalogue())
    for robot in printed["robots"]:
        assert robot["name"] in listed.stdout
        assert {"name", "maker", "joints", "reach_mm", "source"} == set(robot)


def test_problem_in_a_process_of_its_own(tmp_path):
    done = command("status", tmp_path / "nothing")  # which imports no torch
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("pisigma: ")
    assert f"{tmp_path}/nothing" in line


DEFECT = (
    "import sys\nimport pisigma.robot\npisigma.robot.catalogue = lambda: 1 / 0\nsys.argv = ['pisigma', 'robots']\n"
    "from pisigma.cli.main import run\nrun()\n"
)


def with_a_defect(traceback: str) -> "subprocess.CompletedProcess[str]":
    """Run a command that fails by our fault."""
    return subprocess.run(
        [sys.executable, "-c", DEFECT],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, TRACEBACK: traceback},
    )


def test_a_defect_of_ours_exits_1_with_one_line():
    done = with_a_defect(traceback="")
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("pisigma: ")
    assert "ZeroDivisionError: division by zero" in line
    assert f"{TRACEBACK}=1" in line


def test_a_defect_of_ours_shows_its_traceback_on_demand():
    done = with_a_defect(traceback="1")
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "ZeroDivisionError" in done.stderr


@pytest.mark.parametrize("arguments", [["robots"], ["robots", "--json"], ["--help"]])
def test_a_full_disk_for_the_standard_output(arguments):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", START, *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr == (
        "pisigma: cannot write to standard output (No space left on device); redirect it to another file.\n"
    )


def with_full_stderr(*arguments: object) -> int:
    """Return the exit status of a command that cannot write to stderr."""
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-c", START, *map(str, arguments)]
        return subprocess.run(command, stdout=subprocess.PIPE, stderr=full, check=False).returncode


def test_a_full_disk_for_the_standard_error(models, tmp_path):
    (tmp_path / "poses.csv").write_text("x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n300,300,300,0,0,0\n")
    arguments = ("ik", models / "kiro3", "--poses", tmp_path / "poses.csv", "--out", tmp_path / "x.csv")
    assert with_full_stderr(*arguments) == 0
    assert (tmp_path / "x.csv").is_file()
    assert with_full_stderr("status", tmp_path / "nothing") == 2


def test_nobody_reads_what_is_printed():
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-c", START, "robots"],
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_terminal_with_a_small_character_set():
    done = subprocess.run(
        [sys.executable, "-c", START, "robots"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "path",
    ["x" * 5000, "x/" * 2500, "\udcff.yaml", "a\x1b[31m\nb.yaml"],
    ids=["name", "path", "bytes", "control"],
)
def test_paths_that_no_file_can_have(refuses, models, tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    model = str(models / "kiro3")
    for arguments in (
        ("simulate", path, "--out", "x.csv"),
        ("calibrate", "ur5", path, "--out", "x"),
        ("calibrate", path, "x.csv", "--out", "x"),
        ("train", path, "--data", path),
        ("evaluate", path, path),
        ("verify", model, path),
        ("report", path, "--out", "x.html"),
        ("report", model, path),
        ("ik", path, "--pose", 0, 0, 0, 0, 0, 0),
        ("ik", model, "--poses", path, "--out", "x.csv"),
        ("distill", path, "--out", "x"),
        ("export", path, "--format", "dh", "--out", "x.csv"),
        ("upgrade", path),
    ):
        message = refuses(*arguments)
        assert message.isprintable()
        assert len(message) < 1000
    assert list(tmp_path.iterdir()) == []


def test_no_control_character_reaches_a_terminal(capsys):
    print_table("t\x1b[2J", ("a\x07", "b"), [("\x1b]0;x\x07", "\u202e")])
    print_lines(["one\x1b[31m", "two\r\x9b"])
    out = capsys.readouterr().out
    assert "\\x1b[2J" in out
    assert all(letter.isprintable() or letter == "\n" for letter in out)


def test_an_interruption_exits_130_with_one_line():
    script = (
        "import sys\nimport pisigma.robot\n"
        "def interrupted():\n    raise KeyboardInterrupt\n"
        "pisigma.robot.catalogue = interrupted\n"
        "sys.argv = ['pisigma', 'robots']\nfrom pisigma.cli.main import run\nrun()\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert done.stderr == "pisigma: interrupted; nothing was left half written.\n"


def test_the_inverse_imports_no_lightning_and_no_matplotlib(models):
    script = (
        "import sys\nfrom pisigma.cli.main import run\n"
        f"sys.argv = ['pisigma', 'ik', {str(models / 'kiro3')!r}, '--pose', '300', '300', '300', '0', '0', "
        "'0', '--json']\ntry:\n    run()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        "heavy = ('lightning', 'matplotlib', 'scipy', 'pisigma.network')\n"
        "print([name for name in heavy if name in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "[]\n"
    assert json.loads(done.stdout)["solutions"][0]["branch"] == "elbow_positive"


def test_tables_are_never_cut(capsys):
    long = "a" * 150
    print_table("title [bold]x[/bold]", ("name", "value [mm]"), [(long, "1.5"), ("b", "-12.25")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "title [bold]x[/bold]"
    assert any(line.strip().startswith(long) for line in lines)
    assert lines[-2].rstrip().endswith("-12.25")
    assert lines[-3].rstrip().endswith("   1.5")


def test_tables_fit_80_columns(capsys):
    columns = ("tried", "unknowns", "log evidence", "held-out error", "seconds", "kept")
    name = "gravity + conditions + series 110 + products"
    print_table(
        "title",
        columns,
        [(name, "1431", "29288.8", "0.488", "0.5", "yes"), ("x", "1", "", "1.0", "0.1", "no")],
    )
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) == 80
    assert [line.split() for line in lines[1:3]] == [
        ["log", "held-out"],
        [*columns[:2], "evidence", "error", *columns[4:]],
    ]
    assert lines[4].split()[-5:] == ["1431", "29288.8", "0.488", "0.5", "yes"]
    assert lines[5].strip() == "products"


def test_a_missing_extra_is_named_in_one_sentence(refuses, tmp_path, monkeypatch):
    """Without lightning, training says how to get it and writes nothing."""
    (tmp_path / "kiro3.yaml").write_text(small_recipe_text("kiro3"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "lightning", None)  # importing it fails
    monkeypatch.delitem(sys.modules, "pisigma.network.networks", raising=False)
    assert refuses("train", "kiro3.yaml", "--out", "model") == (
        "this needs the package lightning, which is not installed; install it with "
        '`pip install "pisigma[train]"`.'
    )
    assert [path.name for path in tmp_path.iterdir()] == ["kiro3.yaml"]


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (("simulate", "r.yaml", "--out", "r.yaml"), "r.yaml"),
        (("simulate", "r.yaml", "--out", "arm.yaml"), "arm.yaml"),
        (("simulate", "r.yaml", "--out", "m/rows.csv"), "m/rows.csv"),
        (("train", "r.yaml", "--out", "m"), "m"),
        (("train", "r.yaml", "--out", ".", "--overwrite"), "."),
        (("train", "r.yaml", "--out", "new", "--logs", "m"), "m/metrics.csv"),
        (("calibrate", "arm.yaml", "poses.csv", "--out", "arm.yaml"), "arm.yaml"),
        (("calibrate", "ur5", "poses.csv", "--out", "m"), "m"),
        (("distill", "m", "--out", "m", "--overwrite"), "m"),
        (("distill", "m", "--out", "m/small"), "m/small"),
        (("report", "m", "x.html", "--out", "x.html"), "x.html"),
        (("report", "m", "--out", "x.html", "--figures", "m"), "m/figure.png"),
        (("ik", "m", "--poses", "poses.csv", "--out", "m/model.yaml"), "m/model.yaml"),
        (("ik", "m", "--poses", "poses.csv", "--out", "link.csv"), "link.csv"),
        (("ik", "m", "--poses", "poses.csv", "--out", "pipe.csv"), "pipe.csv"),
        (("export", "m", "--format", "dh", "--out", "m/dh.csv"), "m/dh.csv"),
        (("export", "m", "--format", "urdf", "--like", "arm.urdf", "--out", "arm.urdf"), "arm.urdf"),
    ],
)
def test_no_command_writes_over_what_it_reads(refuses, models, tmp_path, monkeypatch, arguments, file):
    shutil.copytree(models / "kiro3", tmp_path / "m")
    (tmp_path / "arm.yaml").write_text(robot_to_yaml(Robot.load("kiro3")))
    (tmp_path / "r.yaml").write_text(small_recipe_text("kiro3").replace("robot: kiro3", "robot: arm.yaml"))
    for name in ("x.html", "poses.csv", "arm.urdf"):
        (tmp_path / name).write_text("mine")
    (tmp_path / "link.csv").symlink_to("poses.csv")
    os.mkfifo(tmp_path / "pipe.csv")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    monkeypatch.chdir(tmp_path)
    refuses(*arguments, error=OutputError, file=file)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_refused_input_is_an_object_of_json_and_a_line(run):
    result = run("robots", "--check", "no_such_robot", "--json")
    error = json.loads(result.stdout)["error"]
    assert result.exit_code == 2
    assert error["class"] == "UnknownRobotError"
    assert error["message"] in result.stderr
    assert error.items() >= problem_of(result).fields().items()
