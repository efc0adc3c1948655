"""Machine code belongs to its sources, and is cached only where other users cannot write."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from testing.refusals import refused

from pisigma.files.errors import ModelError
from pisigma.robot.kernels import build, machine_code
from pisigma.robot.kernels.forms import KernelForms

TRIPLES = ["x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu", "arm64-apple-macosx14.0.0"]


def test_the_intermediate_code_is_that_of_the_sources():
    assert build.read_intermediate_code() is not None, (
        "the kernels changed: run python -m pisigma.joint_correction.registry"
    )


def test_the_stored_machine_code_is_that_of_the_intermediate_code(tmp_path, monkeypatch):
    assert build.read_object() is not None, "run python -m pisigma.joint_correction.registry"
    whole = build.OBJECT.read_bytes()
    monkeypatch.setattr(build, "OBJECT", tmp_path / "kernels.o.xz")
    for wrong in (whole[:-3], b"", whole.replace(b'_sha256": "', b'_sha256": "0')):
        build.OBJECT.write_bytes(wrong)
        assert build.read_object() is None


@pytest.mark.parametrize("lacking", ["avx2", "fma"])
def test_other_processors_compile_the_code_themselves(monkeypatch, lacking):
    features = {**dict.fromkeys(machine_code._FEATURES, True), lacking: False}
    monkeypatch.setattr(machine_code.llvm, "get_host_cpu_features", lambda: features)
    assert not machine_code._runs_stored_code()


def test_short_names_keep_the_code():
    head = 'define i64 @f(i64 %"a.b", i64 %c) {\n'
    body = 'B1.i:  ; preds\n  %.3 = add i64 %"a.b", %c\n  br label %B2\n\nB2:\n  ret i64 %.3\n}\n'
    short = "v2:\n  %v3 = add i64 %v0, %v1\n  br label %v4\n\nv4:\n  ret i64 %v3\n}\n"
    assert build.with_short_names(head + body) == "define i64 @f(i64 %v0, i64 %v1) {\n" + short


def test_the_hash_covers_every_kernel_and_no_comment(tmp_path, monkeypatch):
    files = {path.name for path in build.source_files()}
    assert {"newton.py", "kernels.py", "layout.py", "tolerances.py", "status.py"} <= files
    for path in (Path(build.__file__).parent).glob("*.py"):
        assert "@kernel" not in path.read_text() or path.name in files
    sources = tmp_path / "kernels.py"
    monkeypatch.setattr(build, "source_files", lambda: [sources])

    def hash_of(text: str) -> str:
        sources.write_text(text, encoding="utf-8")
        return build.source_hash()

    before = hash_of('def f(x):\n    """Double."""\n    return 2 * x\n')
    assert hash_of('def f(x):\n    """Twice\n    as much."""\n\n    return 2 * x  # why\n') == before
    assert hash_of("def f(x):\n    return 3 * x\n") != before
    assert hash_of("def f(x):\nreturn 2 * x\n") != before


def test_code_of_other_sources_or_damaged_code_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "FILE", tmp_path / "kernels.ll.xz")
    assert build.read_intermediate_code() is None
    build.write_intermediate_code("define", KernelForms(("series",), ("scara",)), numba="1")
    assert (build.read_intermediate_code(), build.stored_code_forms()) == (
        "define",
        KernelForms(("series",), ("scara",)),
    )
    whole = build.FILE.read_bytes()
    for wrong in (whole[:-3], b"", b"[1]\nx", whole.replace(b'"sources": "', b'"sources": "0')):
        build.FILE.write_bytes(wrong)
        assert build.read_intermediate_code() is None


def test_without_code_and_numba_the_error_names_the_extra(monkeypatch):
    def missing() -> str:
        raise ImportError

    monkeypatch.setattr(machine_code, "_ready_forms", lambda: None)
    monkeypatch.setattr(machine_code, "intermediate_code", missing)
    with refused(ModelError, value="pisigma[compile]"):
        machine_code._intermediate_code(KernelForms())
    monkeypatch.setattr(machine_code, "intermediate_code", lambda: "made now")
    assert machine_code._intermediate_code(KernelForms()) == "made now"


def test_objects_for_other_processors_can_be_made():
    machine_code.llvm.initialize_all_targets()
    machine_code.llvm.initialize_all_asmprinters()
    small = "define i32 @pisigma_run(double %x) {\n  %y = fptosi double %x to i32\n  ret i32 %y\n}\n"
    for triple in TRIPLES:
        assert machine_code.optimised_object(small, machine_code.target_machine(triple))


def test_code_is_read_as_it_was_written_and_damaged_code_is_not(tmp_path):
    file = tmp_path / "deep" / "kernels.o"
    assert machine_code.write_code(file, b"code")
    assert machine_code.read_code(file) == b"code"
    assert [path.name for path in file.parent.iterdir()] == ["kernels.o"]
    assert file.parent.stat().st_mode & 0o777 == 0o700
    whole = file.read_bytes()
    for wrong in (whole[:-1], whole[:10], b"", whole[:-1] + b"x"):
        file.write_bytes(wrong)
        assert machine_code.read_code(file) is None
    assert machine_code.read_code(tmp_path / "missing.o") is None


def test_code_that_other_users_could_have_written_is_not_read(tmp_path, monkeypatch):
    folder, file = tmp_path / "cache", tmp_path / "cache" / "kernels.o"
    assert machine_code.write_code(file, b"code")
    for path, mode in ((file, 0o664), (file, 0o646), (folder, 0o770), (folder, 0o707)):
        kept = path.stat().st_mode
        path.chmod(mode)
        assert machine_code.read_code(file) is None
        assert path == file or not machine_code.write_code(folder / "other.o", b"code")
        path.chmod(kept)
    assert machine_code.read_code(file) == b"code"
    (folder / "link.o").symlink_to(file)
    assert machine_code.read_code(folder / "link.o") is None
    owner = file.stat().st_uid
    monkeypatch.setattr(machine_code.os, "geteuid", lambda: owner + 1)
    assert (machine_code.read_code(file) is None) == (owner != 0)  # root's files are everybody's
    assert not machine_code._trusted(os.stat_result((0o100644, 0, 0, 1, owner + 2, 0, 0, 0, 0, 0)))


def test_an_unwritable_cache_folder_is_skipped(tmp_path):
    (tmp_path / "file").write_text("here is no folder", encoding="utf-8")
    assert not machine_code.write_code(tmp_path / "file" / "kernels.o", b"code")


@pytest.mark.parametrize("stated", ["relative/cache", "", None])
def test_a_relative_cache_and_a_missing_home_are_ignored(stated, tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if stated is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", stated)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert machine_code.cache_folders()[1:] == [tmp_path / ".cache" / "pisigma"]

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(machine_code.Path, "home", homeless)
    assert len(machine_code.cache_folders()) == 1
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert machine_code.cache_folders()[1:] == [tmp_path / "cache" / "pisigma"]


def test_the_key_depends_on_everything_that_the_code_depends_on(monkeypatch):
    key = machine_code._key(KernelForms())
    assert key == machine_code._key(KernelForms())
    for owner, name, other in (
        (machine_code.llvm, "get_host_cpu_name", lambda: "another"),
        (machine_code.llvm, "get_process_triple", lambda: "another"),
        (machine_code.llvm, "llvm_version_info", (1, 0, 0)),
        (machine_code.llvmlite, "__version__", "0.0"),
        (machine_code, "source_hash", lambda: "another"),
        (machine_code, "_OPTIONS", "another"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, other)
            assert machine_code._key(KernelForms()) != key, name


@pytest.mark.parametrize("stored", [True, False])
def test_loading_kernels_on_a_fresh_cache_needs_no_compiler(tmp_path, stored):
    """As on a new machine without numba, from a copy of the package with and without its machine code."""
    package = Path(build.__file__).parents[2]
    left_out = ("__pycache__", "catalogue", *([] if stored else [build.OBJECT.name]))
    shutil.copytree(package, tmp_path / "pisigma", ignore=shutil.ignore_patterns(*left_out))
    script = (
        "import sys\nfor name in ('numba', 'torch'):\n    sys.modules[name] = None\n"
        "from pisigma.robot.kernels.machine_code import load_kernels\nload_kernels()\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "pisigma" / "robot" / "kernels" / "__pycache__"
    compiled = not (stored and machine_code._runs_stored_code())
    assert [path.suffix for path in folder.glob("*.o")] == [".o"] * compiled


def test_the_code_names_its_compilers():
    assert b'"numba"' in build.FILE.read_bytes().partition(b"\n")[0]
    assert build.ENTRY in (build.read_intermediate_code() or "")
