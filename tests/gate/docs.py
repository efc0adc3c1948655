"""Run every block of README and docs that can run here, like a reader: `python tests/gate/run.py docs`.

Python and bash blocks of a page run one after the other in a separate folder. Files that no earlier block has
written are created when they are named; see `gate.doc_inputs`.
"""

import contextlib
import io
import itertools
import multiprocessing
import os
import re
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from gate import doc_inputs as inputs
from gate.option_inputs import REPOSITORY
from gate.options import COMMAND, HASH_OF, Call, run_call

LONGEST_S = 600.0
"""Maximum time of a call [s]; a session that is still running is then ended as by Ctrl-C."""
NOT_HERE: Mapping[str, str] = {
    "python3 -m venv": "installs from the network",
    "pip install": "installs from the network",
    "OMP_NUM_THREADS=1 python benchmarks/": "takes hours",
    "python benchmarks/": "takes hours",
    "pisigma calibrate ur5 corners.csv tracker.csv --camera wrist.yaml": "needs two cameras and a tracker",
    "pisigma calibrate models/my_ur5 corners.csv --only hand-eye": "needs images of a board; options.txt has the call",
    "pisigma use cells/welder7": "names a model of the reader's cell",
    "pisigma export models/my_arm --format fanuc-mastering": "has ... for the counts of the reader's robot",
}
"""Starts of lines that do not run here, and why."""
STATUS: Mapping[str, int] = {
    "pisigma monitor models/my_rb5 2026-11-22.csv": 3,  # a joint has moved
    "pisigma evaluate models/my_rb5 new.csv --max": 3,  # the limits are missed
    "pisigma evaluate models/my_rb5 geometric nominal new.csv": 3,
}
"""Starts of calls with an exit status other than 0, as the page says."""
_BLOCK = re.compile(r"^(?:(?P<marked><!-- runs -->)\n+)?```(?P<language>\w*)\n(?P<text>.*?)^```", re.M | re.S)
COMPARED = ("docs/tutorial.md",)
"""Pages on which a block of text after commands is what they print, apart from days, times and ports."""
_OUTPUTS = ("--out", "--page", "--rest", "--save-map", "--figures")


@dataclass(frozen=True)
class Block:
    """A block of a page.

    Attributes:
        page: path of the page, relative to the repository.
        line: its line on the page.
        language: its language, such as "bash".
        text: its text between the marks.
    """

    page: str
    line: int
    language: str
    text: str

    @property
    def lines(self) -> list[str]:
        """Lines of a bash block, each with its continuation lines."""
        return [line for line in self.text.replace("\\\n", " ").splitlines() if line.strip()]


def blocks(*languages: str) -> list[Block]:
    """Return the blocks of README and all pages, by page and line."""
    found = []
    for path in (REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))):
        text = path.read_text(encoding="utf-8")
        for match in _BLOCK.finditer(text):
            if match["language"] in languages:
                line = text.count("\n", 0, match.start("text")) + 1
                found.append(Block(str(path.relative_to(REPOSITORY)), line, match["language"], match["text"]))
    return found


def reason_not_to_run(line: str) -> str:
    """Return why a line does not run here; "" where it does."""
    return next((why for begin, why in NOT_HERE.items() if line.startswith(begin)), "")


@dataclass
class Page:
    """A page that is run in a folder.

    Attributes:
        name: name of the page.
        small: folder of the small inputs.
        names: names that its Python blocks have defined so far.
        printed: what the last bash block has printed to stdout.
    """

    name: str
    small: Path
    names: dict[str, object]
    printed: str = ""

    def run(self, block: Block) -> Iterator[tuple[str, str]]:
        """Run a block, and return every line that ran (for Python the first one), and the failures."""
        self._need("models/loaded")
        for begin, made in AT.items():
            for name, maker in made.items() if block.text.startswith(begin) else ():
                self._put(name, maker)
        if block.language == "text":
            yield block.text.splitlines()[0], self._compared(block)
            return
        self.printed = ""
        if block.language == "python":
            yield block.text.splitlines()[0], self._python(block)
            return
        for line in block.lines:
            if not reason_not_to_run(line):
                yield line, self._bash(line)

    def _compared(self, block: Block) -> str:
        """Compare a block of text with what the block before it has printed; "..." stands for any lines."""
        printed, begin = normalised(self.printed), 0
        for part in map(normalised, re.split(r"^\.\.\.$", block.text, flags=re.M)):
            found = printed.find(part, begin)
            if found < 0:
                return f"expected {part!r}\n  in {printed[begin:]!r}"
            begin = found + len(part)
        return ""

    def _python(self, block: Block) -> str:
        for name in re.findall(r"(?<!save\()\"([\w./-]+)\"", block.text):
            self._need(name)
        for saved in map(Path, re.findall(r"save\(\"([\w./-]+)\"\)", block.text)):
            if saved.is_dir():
                shutil.rmtree(saved)  # another way to do the same
        before = next((code for begin, code in BEFORE.items() if block.text.startswith(begin)), "")
        try:
            with contextlib.redirect_stdout(io.StringIO()), inputs.no_type_checker():
                exec(before, self.names)
                exec(compile(block.text, f"{self.name}, line {block.line}", "exec"), self.names)
        except BaseException:
            return traceback.format_exc()
        return ""

    def _bash(self, line: str) -> str:
        words = shlex.split(line, comments=True)
        words = words[: next((k for k, word in enumerate(words) if word in ("||", "&&", "|", ";")), None)]
        if words[0] == "sha256sum":
            self._need(str(Path(words[1]).parent))
            return "" if Path(words[1]).is_file() else f"{words[1]}: there is no such file"
        options = (*_OUTPUTS, "--program") if words[1] in ("plan", "measure") else _OUTPUTS
        outputs = {after for before, after in itertools.pairwise(words) if before in options}
        for word in words[1:]:
            if word not in outputs:
                self._need(word.rstrip("/"))
        for out in map(Path, outputs):
            out.parent.mkdir(parents=True, exist_ok=True)
            if out.is_dir() and "--overwrite" not in words:
                shutil.rmtree(out)  # another way to do the same
        words = [f"{HASH_OF}{_model(words)}" if word.endswith("...") else word for word in words]
        status, printed = _session(words) if words[1] == "measure" else self._call(words)
        wanted = next((one for begin, one in STATUS.items() if line.startswith(begin)), 0)
        self.printed += printed
        return "" if status == wanted else f"status {status}, expected {wanted}\n{printed[-1500:]}"

    def _call(self, words: Sequence[str]) -> tuple[int, str]:
        """Run a call, and answer a question with yes."""
        asked = "pisigma.cli.import_"
        with (
            mock.patch(f"{asked}._is_asked", return_value=True),
            mock.patch(f"{asked}.typer.confirm", return_value=True),
        ):
            return run_call(Call(0, 0, tuple(words[1:])))

    def _need(self, name: str) -> None:
        """Create the file or folder of a name where it is missing."""
        maker = MADE.get(self.name, {}).get(name) or inputs.EVERYWHERE.get(name)
        if maker is not None and not Path(name).exists():
            self._put(name, maker)

    def _put(self, name: str, maker: inputs.Maker) -> None:
        path = Path(name).absolute()
        if path.exists():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        path.parent.mkdir(parents=True, exist_ok=True)
        maker(path, self.small)


def normalised(printed: str) -> str:
    """Return a text in one line, with other days, times and ports replaced."""
    for pattern, name in ((r"\d{4}-\d\d-\d\d", "DAY"), (r"\d+\.\d s", "TIME"), (r'(_port": )\d+', r"\1PORT")):
        printed = re.sub(pattern, name, printed)
    return " ".join(printed.split())


def _model(words: Sequence[str]) -> str:
    return f"{words[2]}/model.yaml"


def _session(words: Sequence[str]) -> tuple[int, str]:
    """Follow a session in a separate process."""
    command = [*COMMAND, *words[1:]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            printed, _ = process.communicate(timeout=LONGEST_S)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            printed, _ = process.communicate()
        return process.returncode, printed


def yaml_block(page: str, number: int, head: str = "") -> inputs.Maker:
    """Write a YAML block of a page as a file."""
    text = [block.text for block in blocks("yaml") if block.page == page][number]
    return inputs.text(head + text)


HOW_TO = "docs/how-to/"
_NO_UNITS = (
    "A1,A2,A3,A4,A5,A6,X,Y,Z,note\n10,-80,90,-60,-70,20,812,21,344,ok\n20,-70,80,-50,-60,10,824,33,321,ok\n"
)
_POINTS = "".join(f"p{k},{k}.0,{800 + 7 * k}.5,{30 * k}.25,400.125\n" for k in range(1, 7))
_LOG = "".join(f"p{k},{k}.1,{','.join(str(10 * k + j) + '.5' for j in range(6))}\n" for k in range(1, 7))
MADE: Mapping[str, Mapping[str, inputs.Maker]] = {
    **{
        f"{HOW_TO}{page}.md": inputs.OF_RB5
        for page in ("compare", "monitor", "recalibrate", "read-the-report")
    },
    f"{HOW_TO}verify-and-accept.md": inputs.OF_RB5,
    f"{HOW_TO}corrected-ik.md": {"models/loaded": inputs.copy("loaded")},
    f"{HOW_TO}coupled-joints.md": {
        "my_robot.yaml": yaml_block(f"{HOW_TO}coupled-joints.md", 1, "name: mine\nmaker: we\nsource: ours\n")
    },
    f"{HOW_TO}fleet.md": {
        "fleet.csv": inputs.fleet,
        "few.csv": inputs.measured("ur10", 0, 10, 9),
        "models/welder7": inputs.MY_UR10,
    },
    f"{HOW_TO}fewer-freedoms.md": {"models/my_ur10": inputs.MY_UR10},
    f"{HOW_TO}import.md": {
        "tracker.txt": inputs.copy("exports/kuka.csv"),
        "robot.csv": inputs.text(_NO_UNITS),
        "robot.txt": inputs.text("10 -80 812.5 21.5 344.5 1\n20 -70 824.5 33.5 321.5 2\n"),
        "monday.csv": inputs.copy("exports/kuka.csv"),
        "tuesday.csv": inputs.copy("exports/kuka.csv"),
        "points.txt": inputs.text(f"name,time [s],x [mm],y [mm],z [mm]\n{_POINTS}"),
        "joints.csv": inputs.text(f"name,time [s],{','.join(f'J{k} [deg]' for k in range(1, 7))}\n{_LOG}"),
    },
    f"{HOW_TO}measure.md": {"tracker.csv": inputs.tracked_plan},
    f"{HOW_TO}plan.md": {
        "models/my_ur10": inputs.MY_UR10,
        "welding.csv": inputs.joints_near(inputs.UR5_NEAR),
    },
    f"{HOW_TO}to-the-controller.md": {
        "models/my_arm": inputs.six_calibrated,
        "models/my_tx2": inputs.calibrated("ur10", "--model", "geometric"),
        "models/my_scara": inputs.calibrated("kiro3", "--model", "geometric"),
        "cell.script": inputs.ur_program,
        "weld.ls": inputs.fanuc_program,
        "controller/calibration.conf": inputs.exported(inputs.MY_UR5, "ur-calibration"),
        "controller/arm.cfx": inputs.copy("arm.cfx"),
    },
    f"{HOW_TO}calibrate-files.md": {"grid.csv": inputs.measured("ur5")},
}
"""How to create the files that a page names."""
AT: Mapping[str, Mapping[str, inputs.Maker]] = {
    "pisigma new ur5 --out cells/welder7": {
        "measured.csv": inputs.measured("ur5", 0, 40),
        "check.csv": inputs.measured("ur5", 40, 50),
        "november.csv": inputs.measured("ur5", 50, 60),
    },
    "pisigma robots --check mast.yaml": {"mast.yaml": inputs.mast},
    "pisigma calibrate my_robot.yaml": {
        "my_robot.yaml": yaml_block(f"{HOW_TO}add-a-robot.md", 0),
        "tracker.csv": inputs.measured("my_robot.yaml"),
    },
    "pisigma calibrate arm.urdf tracker.csv": {"tracker.csv": inputs.six_rows},
    "pisigma export models/my_ur5 --format targets --program": {
        "frames.yaml": yaml_block(f"{HOW_TO}to-the-controller.md", 0)
    },
    'pip install "pisigma[camera]"': {"board.yaml": yaml_block(f"{HOW_TO}camera.md", 0)},
    "pisigma camera calibration/": {
        "calibration": inputs.images(""),
        "images": inputs.images(""),
        "board.yaml": inputs.images("board.yaml"),
        "joints.csv": inputs.images("joints.csv"),
    },
    "pisigma monitor models/my_ur5 2026-11-20.csv": {"2026-11-20.csv": inputs.images("corners", 2)},
    "pisigma plan ur5 --sensor camera": {"cell.yaml": inputs.copy("view.yaml")},
}
"""How to create files that are named after a block with this start."""


BEFORE = {"loaded = ik.under": 'ik = pisigma.load("models/loaded")'}
"""Code to run before a Python block with this start, as its text says."""


def run_page(name: str, small: Path, folder: Path) -> int:
    """Run all blocks of a page in a folder, print the failures and return their number."""
    import numpy as np

    folder.mkdir()
    os.chdir(folder)
    Path("training").symlink_to(REPOSITORY / "training")
    Path("models").mkdir()
    for model in ("kiro3", "kiro4"):
        Path("models", model).symlink_to(REPOSITORY / "models" / model)
    page = Page(name, small, {"q_now": np.deg2rad(inputs.UR5_NEAR), "T_base_tool": inputs.T_NEAR.numpy()})
    failed = 0
    languages = ("bash", "python", "text") if name in COMPARED else ("bash", "python")
    for block in [one for one in blocks(*languages) if one.page == name]:
        begun = time.perf_counter()
        try:
            ran = list(page.run(block))
        except Exception:
            ran = [(block.lines[0], traceback.format_exc())]
        for line, problem in ran:
            sign = "FAILED" if problem else "ok"
            seconds = time.perf_counter() - begun
            print(f"{sign} {seconds:5.1f} s {name}, line {block.line}: {line}", flush=True)
            failed += bool(problem)
            if problem:
                print("  " + problem.replace("\n", "\n  "), flush=True)
    return failed


def main() -> int:
    """Run every page in a separate process, as plug-ins stay registered, and return the number of failures."""
    chosen = os.environ.get("GATE_PAGES", "")
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        small = inputs.small_inputs(Path(folder) / "small")
        for number, name in enumerate(dict.fromkeys(block.page for block in blocks("bash", "python"))):
            if chosen not in name:
                continue
            with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
                failed += pool.submit(run_page, name, small, Path(folder) / str(number)).result()
    return failed
