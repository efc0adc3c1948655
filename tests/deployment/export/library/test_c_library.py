"""The shared library has the numbers of Python to 1e-12 in C, and refuses foreign model files."""

import shutil
import subprocess

import numpy as np
import pytest
from testing.calibrated_arm import calibrated_arm, joints_of
from testing.closeness import assert_close
from testing.models import hand_made_model, no_type_checker
from testing.refusals import refused
from testing.serving import CLIENTS

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.library.c_library import HEADER, LIBRARY, MODEL, model_file
from pisigma.deployment.export.registry import export_model
from pisigma.files.errors import OutputError
from pisigma.model.inverse.corrected_ik import CorrectedIK

pytestmark = [
    pytest.mark.usefixtures("without_type_checker"),
    pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on the path"),
]


@pytest.fixture(scope="module")
def exported(repository, tmp_path_factory):
    """The folder of an export, with the program of the documentation."""
    folder = tmp_path_factory.mktemp("library") / "made"
    with no_type_checker():
        export_model("library", ExportRequest(repository / "models" / "kiro4", folder))
    program = CLIENTS / "library_example.c"
    command = f"gcc -std=c11 -Wall -Wextra -Werror -I {folder} {program} -L {folder} -lpisigma_ik -lm"
    subprocess.run([*command.split(), f"-Wl,-rpath,{folder}", "-o", folder / "example"], check=True)
    return folder


def _answers(folder, model, rows):
    text = "\n".join(" ".join(f"{value!r}" for value in row) for row in rows.tolist())
    done = subprocess.run([folder / "example", model], input=text, capture_output=True, text=True, check=True)
    return np.array([[float(word) for word in line.split()] for line in done.stdout.splitlines()])


@pytest.mark.parametrize(
    ("make", "name", "options"),
    [
        (calibrated_arm, "ur10", {}),
        (calibrated_arm, "rb5", {"hybrid": False}),
        (calibrated_arm, "panda", {}),
        (hand_made_model, "kiro3", {}),
    ],
)
def test_c_has_the_numbers_of_python(exported, tmp_path, make, name, options):
    model = make(name, **options)
    ik, dof = CorrectedIK(model), model.robot.dof
    (tmp_path / MODEL).write_bytes(model_file(model))
    q = joints_of(model.robot, 60, share=0.9).numpy()
    T = np.asarray(ik.forward(q))
    near = q + 0.01
    near[::2] = np.nan
    T[::20, 0, 3] += 9
    near[1::20, 0] = 100.0
    answers = _answers(exported, tmp_path / MODEL, np.concatenate([T.reshape(-1, 16), near], 1))
    assert len(answers) == len(T)
    reached = 0
    for pose, beside, row in zip(T, near, answers, strict=True):
        solution = ik(pose, near=None if np.isnan(beside[0]) else beside, throw=False)
        assert row[0] == solution.status
        if np.isnan(solution.q).any():
            assert np.isnan(row[1 : dof + 3]).all()
            continue
        reached += 1
        assert_close(row[1 : dof + 1], solution.q, atol=1e-12)
        residuals = [float(solution.position_residual), float(solution.rotation_residual)]
        assert_close(row[dof + 1 : dof + 3], residuals, atol=1e-12)
        if model.network is None:
            assert_close(row[dof + 3 :].reshape(4, 4), ik.forward(solution.q), atol=1e-12)
        else:
            assert len(row) == dof + 3
    assert reached > 30


def test_a_foreign_file_is_refused(exported, tmp_path):
    content = (exported / MODEL).read_bytes()
    middle = len(content) // 2
    cases = {
        b"": "not a model file",
        b"x" * 1000: "not a model file",
        content[:8] + b"\0" * 8 + content[16:]: "another version",
        content[:-1]: "truncated",
        content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]: "truncated",
    }
    for wrong, sentence in cases.items():
        (tmp_path / MODEL).write_bytes(wrong)
        done = subprocess.run(
            [exported / "example", tmp_path / MODEL], capture_output=True, text=True, check=False
        )
        assert done.returncode == 2
        assert sentence in done.stderr


def test_a_folder_has_three_files_and_a_missing_compiler_is_reported(
    exported, repository, tmp_path, monkeypatch
):
    assert {HEADER, LIBRARY, MODEL} <= {path.name for path in exported.iterdir()}
    model = repository / "models" / "kiro4"
    monkeypatch.setenv("CC", "no-such-compiler")
    with refused(OutputError, value="no-such-compiler"):
        export_model("library", ExportRequest(model, tmp_path / "made"))
    assert not (tmp_path / "made").exists()
    with pytest.raises(OutputError, match=str(model)):
        export_model("library", ExportRequest(model, model))
    (tmp_path / "file").write_text("")
    monkeypatch.delenv("CC")
    with refused(OutputError, file=str(tmp_path / "file"), option="--out"):
        export_model("library", ExportRequest(model, tmp_path / "file"))
