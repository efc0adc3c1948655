"""Hostile command lines: values of options that are not valid, and unsuitable paths."""

import shutil
from pathlib import Path

from hostile.case import Case, Rng, calibrate, one_of
from hostile.clean import Clean
from hostile.damage import NUMBERS, TEXTS

_OUTPUTS = (
    "", ".", "..", "a" * 5000, "a/" * 2000, "no/such/folder/x", "x\ny", "\udcff\udcfe", "-", "--", "/dev/full/x",
    "rows.csv/x", "rows.csv", "~", "x\x1b[31m", "robot.yaml", "model", "model/model.yaml", "CON",
)  # fmt: skip
_INPUTS = (*_OUTPUTS, "/", "/dev/null", "/dev/zero", "/proc/self/mem")
_WORDS = tuple(text for text in (*NUMBERS, *TEXTS) if "\x00" not in text)
_COUNTS = ("0", "-1", "1", "1e9", "1000000000", "9" * 30, "2.5", "x", "", "nan")
_NUMBERS = ("0", "-1", "nan", "inf", "1e300", "1e-300", "x", "", "1,5", "-0")
_CALIBRATE = {
    "--folds": _COUNTS, "--set=hold_out": (*_NUMBERS, "0.5", "1", "0.999"),
    "--split": (*_WORDS, "time", "space", "placement"), "--set=repeats": _COUNTS,
    "--set=seed": (*_COUNTS, "-9223372036854775809"), "--set=train_rows": (*_COUNTS, "5"), "--set=prior_mm": _NUMBERS,
    "--set=prior_mrad": _NUMBERS, "--set=free": (*_WORDS, "a_2,a_2", "a_99", ",", "theta_1"), "--model": _WORDS,
    "--set=socket_sigma_mm": _NUMBERS,
    "--set=socket_distance": (*_WORDS, "a,b", "a,b,-1", "*,*,50", "a,b,nan", "*/0,*/1,1e300", "(,),1"),
    "--base": _WORDS, "--tip": _WORDS, "--set": (*_WORDS, "fold=3", "=", "seed=1", "folds=0"),
}  # fmt: skip


def wrong_calibrate(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Return `pisigma calibrate` with a wrong option or path."""
    rows = clean.rows["ur5"]
    shutil.copy(rows.path, folder / "rows.csv")
    option = one_of(rng, (*_CALIBRATE, "ROBOT", "DATA", "--out"))
    if option == "ROBOT":
        arguments = calibrate(one_of(rng, (*_INPUTS, *_WORDS)), "rows.csv")
    elif option == "DATA":
        arguments = calibrate("ur5", one_of(rng, _INPUTS))
    elif option == "--out":
        arguments = (
            "calibrate",
            "ur5",
            "rows.csv",
            "--model",
            "geometric",
            "--folds",
            "0",
            "--out",
            one_of(rng, _OUTPUTS),
        )
    else:
        value = one_of(rng, _CALIBRATE[option])
        arguments = tuple(
            word
            for word in calibrate("ur5", "rows.csv")
            if option != "--folds" or word not in ("--folds", "0")
        )
        if option in ("--set=hold_out", "--set=repeats"):
            arguments = ("calibrate", "ur5", "rows.csv", "--out", "out", "--model", "geometric")
        elif option == "--set=seed":
            arguments = (*arguments, "--folds", "2", "--set", "repeats=1")
        arguments = (*arguments, f"{option}={value}")
    return Case(f"{option} {arguments[-1][:30]!r}", arguments)


def wrong_ik(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Return `pisigma ik` with a wrong pose, option or path."""
    model = str(one_of(rng, list(clean.models)))
    shutil.copy(clean.poses, folder / "poses.csv")
    pose = ["300", "200", "400", "0", "90", "0"]
    options = {
        "pose": lambda: ("--pose", *_with(rng, pose, (*_NUMBERS, "1e15", "500000", "nan"))),
        "branch": lambda: ("--pose", *pose, "--branch", one_of(rng, _WORDS)),
        "payload": lambda: ("--pose", *pose, f"--payload-kg={one_of(rng, _NUMBERS)}"),
        "temperature": lambda: (
            "--pose",
            *pose,
            f"--temperature-c={one_of(rng, (*_NUMBERS, '-400', '293'))}",
        ),
        "poses": lambda: ("--poses", one_of(rng, _INPUTS), "--out", "joints.csv"),
        "out": lambda: (
            "--poses",
            "poses.csv",
            "--out",
            one_of(rng, (*_OUTPUTS, "poses.csv", model + "/model.yaml")),
        ),
        "together": lambda: (
            "--pose",
            *pose,
            *one_of(rng, (("--poses", "poses.csv"), ("--out", "x"), ("--path",))),
        ),
    }
    option = one_of(rng, list(options))
    source = model if rng.random() < 0.85 else one_of(rng, _INPUTS)
    arguments = ("ik", source, *options[option]())
    return Case(f"{option}: {' '.join(arguments[2:])[:60]!r}", arguments)


def _with(rng: Rng, words: list[str], values: tuple[str, ...]) -> list[str]:
    """Return the words with one of them replaced."""
    index = int(rng.integers(len(words)))
    return [*words[:index], one_of(rng, values), *words[index + 1 :]]


def wrong_judging(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Return `pisigma evaluate`, `verify`, `report` or `export` with wrong options or paths."""
    model, rows = one_of(rng, list(clean.models.items()))
    shutil.copy(rows, folder / "rows.csv")
    path = one_of(rng, _INPUTS)
    others = [name for name in _OUTPUTS if name != "rows.csv"]  # which an export may replace
    commands = (
        (
            "evaluate",
            str(model),
            "rows.csv",
            "--set",
            "resamples=20",
            f"--max-mean-mm={one_of(rng, _NUMBERS)}",
        ),
        (
            "evaluate",
            str(model),
            "rows.csv",
            "--set",
            f"resamples={one_of(rng, ('0', '1', '-1', '2', '10000000000', 'x'))}",
        ),
        ("evaluate", str(model), "rows.csv", "--set", f"seed={one_of(rng, _COUNTS)}", "--set", "resamples=2"),
        (
            "evaluate",
            str(model),
            *one_of(rng, (("nominal",), (str(model), "rows.csv"), (path, "rows.csv"), (path,))),
        ),
        ("evaluate", "nominal", "rows.csv"),
        ("evaluate", str(model), "geometric", "rows.csv", "--set", "resamples=20"),
        ("verify", str(model), path),
        ("verify", path, "rows.csv"),
        ("export", str(model), "--format", one_of(rng, _WORDS), "--out", "x.csv"),
        ("export", str(model), "--format", one_of(rng, ("dh", "urdf")), "--out", one_of(rng, others)),
        ("export", path, "--format", "dh", "--out", "x.csv"),
        ("upgrade", path),
        ("simulate", path, "--out", "rows.csv"),
        ("report", path, "--out", "x.html"),
        (one_of(rng, [word for word in _WORDS if word != "--"]), str(model)),
    )
    command = one_of(rng, commands)
    return Case(f"{command[0]}: {' '.join(command[1:])[-40:]!r}", command)
