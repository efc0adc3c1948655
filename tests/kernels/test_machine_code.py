"""Machine code in files: whole or not used, and loaded without the compiler."""

import subprocess
import sys

from pisigma.kernels import machine_code


def test_code_is_read_as_it_was_written_and_damaged_code_is_not(tmp_path):
    file = tmp_path / "deep" / "kernels.o"
    assert machine_code._write(file, b"code")
    assert machine_code._read(file) == b"code"
    assert [path.name for path in file.parent.iterdir()] == ["kernels.o"]
    whole = file.read_bytes()
    for wrong in (whole[:-1], whole[:10], b"", whole[:-1] + b"x"):
        file.write_bytes(wrong)
        assert machine_code._read(file) is None
    assert machine_code._read(tmp_path / "missing.o") is None


def test_a_folder_that_cannot_be_written_is_no_failure(tmp_path):
    (tmp_path / "file").write_text("here is no folder", encoding="utf-8")
    assert not machine_code._write(tmp_path / "file" / "kernels.o", b"code")


def test_the_key_tells_kernels_apart(tmp_path, monkeypatch):
    key = machine_code._key()
    assert key == machine_code._key()
    monkeypatch.setattr(machine_code.llvm, "get_host_cpu_name", lambda: "another")
    assert machine_code._key() != key
    monkeypatch.undo()
    monkeypatch.setattr(machine_code, "__file__", str(tmp_path / "machine_code.py"))
    (tmp_path / "solver.py").write_text("a = 1", encoding="utf-8")
    before = machine_code._key()
    (tmp_path / "solver.py").write_text("a = 2", encoding="utf-8")
    assert machine_code._key() == before
    (tmp_path / "newton.py").write_text("a = 2", encoding="utf-8")
    assert machine_code._key() != before


def test_loading_compiled_kernels_imports_no_compiler():
    machine_code.load_kernels()  # compiles them where they are not yet
    script = (
        "import sys\nfrom pisigma.kernels.machine_code import load_kernels\nload_kernels()\n"
        "assert not [name for name in ('numba', 'torch') if name in sys.modules]\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
