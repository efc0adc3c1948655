"""Test the workbench in Chromium with clicks and keys alone: all steps, mistakes, times, and hostile requests.

Run `python benchmarks/workbench.py FOLDER_OF_SIM [--arms kr10 rail] [--parts arms mistakes times fuzz]` on an otherwise
idle machine with the extra `view`, playwright and chromium. FOLDER_OF_SIM contains `sim.py` and URDF files of the arms.

- arms: go from an empty folder to a corrected KRL program with the forms of the page, and compare the files of the cell
  with those of the same commands byte by byte.
- mistakes: upload rows in inches, with a reversed sign of joint 4, with two swapped joint columns and with a moved
  tracker, and measure the times until the mistake is named and until its repair by the button is checked.
- times: measure the times until the page and an appended row are shown, with 10,000 rows in three dimensions.
- fuzz: send hostile uploads and forms, reload the page during a calibration, and use two browsers at once.
"""

import argparse
import contextlib
import hashlib
import io
import logging
import math
import random
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from hostile_requests import hostile_request
from playwright.sync_api import Browser, sync_playwright
from simulated_arm import import_simulator
from workbench_page import command, do, measured, opened, show, upload

from pisigma.deployment.export.targets import POSE_COLUMNS
from pisigma.measurement.dataset import Measurements
from pisigma.planning.session.state import RowsSoFar
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import xyz_zyx_from_transform
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.load import load

ARMS = ("kr10", "irb120", "arm7", "scara", "rail")
KRL_ARMS = ("kr10", "irb120")
"""Arms with six revolute joints, as KRL programs require; the targets of the others are exported as a table."""
CHROMIUM = (
    "--no-sandbox --disable-background-networking --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader"
)
PLAN, CALIBRATE = {"count": "20", "check": "5"}, {"model": "geometric", "folds": "0"}
"""Settings that are filled in so that the page is timed and not the calculation."""
ROWS, CHECK_ROWS, MANY_ROWS = 60, 20, 10_000
ROW_EVERY = 1500
"""Time between two rows that are appended [ms]; a robot takes longer from pose to pose."""
REQUESTS, RELOADS = 500, 50
COMPARED = (
    "cell.yaml",
    "plans/*",
    "sessions/*",
    "models/*/model.yaml",
    "models/*/*.safetensors",
    "exports/*",
)


def by_clicks(browser: Browser, folder: Path, urdf: Path, first: Path, second: Path, program: Path) -> float:
    """Carry out all steps on the page; return the time until the page is shown [s]."""
    with opened(browser, folder) as (page, _, seconds):
        page.set_input_files("[data-links]", urdf)
        page.wait_for_selector("[name=tip] option:nth-child(2)", state="attached")
        do(page, "new")
        page.wait_for_selector("#tab-plan")
        show(page, "plan")
        do(page, "plan", **PLAN)
        show(page, "measure")
        upload(page, first)
        do(page, "import")
        show(page, "calibrate")
        do(page, "calibrate", **CALIBRATE)
        show(page, "measure")
        upload(page, second)
        do(page, "import")
        show(page, "verify")
        do(page, "verify")
        show(page, "deliver")
        pose = reachable_pose(Cell.open(folder), first)
        do(page, "ik", **pose)
        poses = folder.parent / "poses.csv"
        poses.write_text(f"{','.join(pose)}\n{','.join(pose.values())}\n")
        page.select_option("[name=format]", "targets")
        page.set_input_files("[data-upload=poses]", poses)
        do(page, "export", out=str(program))
        do(page, "serve")
        assert "µs in the median" in page.inner_text("form[data-step=serve]")
        do(page, "serve")
    return seconds


def by_commands(folder: Path, urdf: Path, first: Path, second: Path, program: Path) -> None:
    """Carry out the same steps with commands."""
    command("new", urdf, "--out", folder)
    command("plan", folder, *(word for key, value in PLAN.items() for word in (f"--{key}", value)))
    command("import", first, "--cell", folder)
    command("calibrate", folder, *(word for key, value in CALIBRATE.items() for word in (f"--{key}", value)))
    command("import", second, "--cell", folder)
    command("verify", folder)
    (folder / "exports").mkdir(exist_ok=True)
    command(
        "export",
        folder,
        "--format",
        "targets",
        "--poses",
        folder.parent / "poses.csv",
        "--out",
        folder / "exports" / program,
    )


def reachable_pose(cell: Cell, rows: Path) -> dict[str, str]:
    """Return the first pose of some rows that the model reaches, by the names of the fields."""
    model = cell.model
    assert model is not None
    T = forward_kinematics(model.robot, Measurements.read_csv(rows, cell.robot).q)
    reached = (load(cell.folder)(T).status == Status.REACHED).nonzero()[:, 0].tolist()
    x, y, z, *angles = xyz_zyx_from_transform(T[reached[0]]).tolist()
    values = (1e3 * x, 1e3 * y, 1e3 * z, *map(math.degrees, angles))
    return dict(zip(POSE_COLUMNS, map(repr, values), strict=True))


def different_files(one: Path, other: Path) -> tuple[int, list[str]]:
    """Return the number of compared files of two cells, and the names of those that differ."""
    names = sorted(
        {
            str(path.relative_to(folder))
            for folder in (one, other)
            for name in COMPARED
            for path in folder.glob(name)
        }
    )
    bytes_of = [
        {name: (folder / name).read_bytes() if (folder / name).is_file() else b"" for name in names}
        for folder in (one, other)
    ]
    return len(names), [name for name in names if bytes_of[0][name] != bytes_of[1][name]]


def run_arms(browser: Browser, simulated: Path, arms: list[str], work: Path) -> None:
    """Compare the page with the commands for every arm."""
    sim = import_simulator(simulated)
    print(f"{'arm':<8}{'page shown [s]':>15}{'all steps [s]':>15}{'files':>7}  differ from the commands")
    for arm in arms:
        folder = work / arm
        folder.mkdir()
        first = measured(sim, arm, ROWS, 1, folder / "2026-11-01.csv")
        second = measured(sim, arm, CHECK_ROWS, 2, folder / "2026-11-02.csv")
        program = Path("job.src" if arm in KRL_ARMS else "job.csv")
        begun = time.perf_counter()
        seconds = by_clicks(browser, folder / "page", simulated / f"{arm}.urdf", first, second, program)
        whole = time.perf_counter() - begun
        by_commands(folder / "commands", simulated / f"{arm}.urdf", first, second, program)
        count, different = different_files(folder / "page", folder / "commands")
        print(
            f"{arm:<8}{seconds:>15.2f}{whole:>15.1f}{count:>7}  {', '.join(different) or 'none'}", flush=True
        )


def mistaken(rows: Path, folder: Path) -> dict[str, Path]:
    """Write rows with each of the four mistakes."""
    header, *lines = rows.read_text().splitlines()
    right = np.array([line.split(",") for line in lines], dtype=float)
    values = {
        name: right.copy() for name in ("inches", "sign of joint 4", "swapped columns", "tracker moved")
    }
    values["inches"][:, 6:] /= 25.4
    values["sign of joint 4"][:, 3] *= -1
    values["swapped columns"][:, [1, 2]] = right[:, [2, 1]]
    values["tracker moved"][len(right) // 2 :, 6:] += [300.0, -200.0, 100.0]
    paths = {}
    for name, table in values.items():
        paths[name] = folder / f"{name.replace(' ', '_')}.csv"
        np.savetxt(paths[name], table, delimiter=",", header=header, comments="", fmt="%.17g")
    return paths


def run_mistakes(browser: Browser, simulated: Path, work: Path) -> None:
    """Upload the mistakes, repair them with the button, and add the rows."""
    work = work / "mistakes"
    work.mkdir()
    rows = measured(import_simulator(simulated), "kr10", ROWS, 1, work / "2026-11-01.csv")
    print(f"{'mistake':<17}{'columns [s]':>12}{'named [s]':>11}{'repaired [s]':>13}  named as, repair")
    for name, path in mistaken(rows, work).items():
        cell = Cell.create(work / path.stem, simulated / "kr10.urdf")
        with opened(browser, cell.folder) as (page, _, _):
            show(page, "measure")
            read, named = upload(page, path)
            cause = page.get_attribute("#findings .refusal", "data-cause")
            begun, text = time.perf_counter(), page.inner_text("[data-repair]")
            page.press("[data-repair]", "Enter")
            page.wait_for_selector("#findings > .good")
            repaired = time.perf_counter() - begun
            do(page, "import")
        (entry,) = cell.history.sessions()
        assert entry.remark.startswith("Imported with "), entry.remark
        print(f"{name:<17}{read:>12.2f}{named:>11.2f}{repaired:>13.2f}  {cause}: {text}"[:100], flush=True)


def run_times(browser: Browser, simulated: Path, work: Path) -> None:
    """Measure the page with its scene."""
    folder, sim = work / "times", import_simulator(simulated)
    cell = Cell.create(folder, simulated / "kr10.urdf")
    cell.plan(count=20, check=0, candidates=200)
    lines = measured(sim, "kr10", ROWS, 1, work / "rows.csv").read_text().splitlines(keepends=True)
    growing = work / "growing.csv"
    growing.write_text("".join(lines[:21]))
    with opened(browser, folder, scene=True, rows=growing) as (page, bench, seconds):
        scene = next(one for one in page.frames if "/scene/" in one.url)
        scene.wait_for_selector("canvas")
        print(f"page shown: {seconds:.2f} s (limit: 3 s)")
        show(page, "measure")
        page.press("form[data-step=follow] button[type=submit]", "Enter")
        page.wait_for_selector("[data-rows='20']")
        waits = []
        for row in range(21, 41):
            page.wait_for_timeout(ROW_EVERY)
            begun = time.perf_counter()
            with growing.open("a") as file:
                file.write(lines[row])
            page.wait_for_selector(f"[data-rows='{row}']")
            waits.append(time.perf_counter() - begun)
        print(
            f"row appended to shown: median {np.median(waits):.2f} s, largest {max(waits):.2f} s of "
            f"{len(waits)} (asked: 0.3 s)"
        )
        true = sim.True_("kr10", seed=3)
        q, rng = true.sample(MANY_ROWS, 5), np.random.default_rng(0)
        no = np.zeros(MANY_ROWS, dtype=bool)
        rows = RowsSoFar(
            tuple(range(2, MANY_ROWS + 2)), q, true.tip(q)[0], rng.normal(0, 3e-4, (MANY_ROWS, 3)), no, no
        )
        before = frames(scene)
        begun = time.perf_counter()
        bench._scene.show_rows(rows)
        sent = time.perf_counter() - begun
        page.wait_for_timeout(3000)
        print(
            f"10,000 rows, points and line segments of one object each: sent in {sent:.2f} s; "
            f"{frames(scene):.1f} pictures/s in software, {before:.1f} without rows"
        )


def frames(scene: Any) -> float:
    """Return the pictures per second of the scene over three seconds."""
    return float(
        scene.evaluate("""() => new Promise(done => {
          let count = 0; const begun = performance.now();
          const next = () => { count++; const passed = performance.now() - begun;
            if (passed < 3000) requestAnimationFrame(next); else done(1000 * count / passed); };
          requestAnimationFrame(next); })""")
    )


ASK = """async ([path, method, body]) => {
  const answer = await fetch(path, { method, body: method === "GET" ? undefined : body });
  return [answer.status, await answer.text()]; }"""


def run_fuzz(browser: Browser, simulated: Path, work: Path, seed: int) -> None:
    """Send hostile requests, reload the page during a calibration, and open it in two browsers."""
    folder, chosen = work / "fuzz", random.Random(seed)
    cell = Cell.create(folder, simulated / "kr10.urdf")
    cell.add_session(measured(import_simulator(simulated), "kr10", ROWS, 1, work / "2026-11-01.csv"))
    shutil.copytree(folder, work / "same")
    before, said = digests(folder), io.StringIO()
    handler = logging.StreamHandler(said)
    logging.getLogger("aiohttp").addHandler(handler)
    with contextlib.redirect_stderr(said), opened(browser, folder, hostile=True) as (page, bench, _):
        statuses: dict[int, int] = {}
        for _ in range(REQUESTS):
            status, text = page.evaluate(ASK, hostile_request(chosen))
            statuses[status] = statuses.get(status, 0) + 1
            assert status < 500, text
            assert "Traceback" not in text
            while bench.jobs.running is not None:
                time.sleep(0.01)
        assert all("defect" not in one.refusal for one in bench.jobs.outcomes.values()), bench.jobs.outcomes
        assert digests(folder) == before
        print(
            f"{REQUESTS} hostile requests: statuses {dict(sorted(statuses.items()))}, no traceback, nothing changed"
        )
        with contextlib.closing(browser.new_context()) as context:
            other = context.new_page()
            other.goto(bench.url)
            show(page, "calibrate")
            for name, value in CALIBRATE.items():
                page.fill(f"form[data-step=calibrate] [name={name}]", value)
            ended = bench.jobs.ended
            page.press("form[data-step=calibrate] button[type=submit]", "Enter")
            for _ in range(RELOADS):
                chosen.choice((page, other)).reload(wait_until="commit")
            while bench.jobs.ended == ended:
                time.sleep(0.05)
            for one in (page, other):
                one.goto(f"{one.url.partition('#')[0]}#calibrate")
                one.reload()
                one.wait_for_selector(".outcome dd")
    command(
        "calibrate",
        work / "same",
        *(word for key, value in CALIBRATE.items() for word in (f"--{key}", value)),
    )
    count, different = different_files(folder, work / "same")
    assert not different, different
    assert "Traceback" not in said.getvalue(), said.getvalue()
    print(f"{RELOADS} reloads of two browsers during a calibration: {count} files as those of the command")


def digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the files of a cell except its history."""
    files = [one for one in folder.rglob("*") if one.is_file() and "history" not in one.name]
    return {str(one.relative_to(folder)): hashlib.sha256(one.read_bytes()).hexdigest() for one in files}


def main() -> None:
    """Run the parts that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("simulated", type=Path)
    parser.add_argument("--arms", nargs="+", default=ARMS, choices=ARMS)
    parser.add_argument("--parts", nargs="+", default=("arms", "mistakes", "times", "fuzz"))
    parser.add_argument("--seed", type=int, default=0)
    stated = parser.parse_args()
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with sync_playwright() as running, tempfile.TemporaryDirectory() as folder:
        browser, work = running.chromium.launch(executable_path=path, args=CHROMIUM.split()), Path(folder)
        if "arms" in stated.parts:
            run_arms(browser, stated.simulated, stated.arms, work)
        if "mistakes" in stated.parts:
            run_mistakes(browser, stated.simulated, work)
        if "times" in stated.parts:
            run_times(browser, stated.simulated, work)
        if "fuzz" in stated.parts:
            run_fuzz(browser, stated.simulated, work, stated.seed)
        browser.close()


if __name__ == "__main__":
    main()
