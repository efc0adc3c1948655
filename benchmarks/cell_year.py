"""Simulate years of a cell: whether events are named, wrong sessions are refused, and the model in use is accurate.

`python benchmarks/cell_year.py FOLDER_OF_SIM [--arm irb120] [--seeds 20]`

FOLDER_OF_SIM contains the independent simulator `sim.py` and its URDF files. An arm is calibrated with 80 poses and
verified with 10. Then 12 sessions of 10 poses are imported, one a month, while joint 2 drifts by 0.005 deg a month, a
collision moves joint 3 by 0.05 deg in month 7, the tracker is set up again in month 9, and the reflector is changed in
month 10. No event is recorded by hand. A session of another robot and a session in inches are imported too. The steps
that `pisigma status` names (monitor, recalibrate) are carried out. Every month the simulator evaluates the model in use
at 300 other poses after a rigid fit, compared with the previous model, a recalibration with the session, and a
calibration from all rows since the last true event.
"""

import argparse
import datetime
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from simulated_arm import import_simulator, position_error

from pisigma.files.errors import PisigmaError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.recalibrate import recalibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

QUIET = CalibrationSettings(folds=0)
WANTED = {7: "joint 3", 9: "base", 10: "tool"}
"""Changes that have to be named, by month."""


class Year:
    """One arm with its cell and its simulator."""

    def __init__(self, sim: Any, arm: str, seed: int, folder: Path) -> None:
        """Create the cell, calibrate and verify."""
        self.sim, self.true, self.folder = sim, sim.True_(arm, seed=seed), folder
        self.tool: tuple[float, ...] | None = None
        self.judged = self.true.sample(300, 99)
        self.wrong_steps = 0
        self.cell = Cell.create(folder / "cell", sim_folder(sim) / f"{arm}.urdf", limit_mm=0.5)
        today = datetime.date.today()
        self.days = [
            (today - datetime.timedelta(days=30 * (12 - month) + 1)).isoformat() for month in range(13)
        ]
        earlier = (today - datetime.timedelta(days=400)).isoformat()
        self.cell.add_session(self.rows(80, 1), day=earlier)
        self.cell.calibrate(folds=0)
        self.cell.add_session(self.rows(10, 2), day=self.days[0])
        self.cell.verify()
        self.since = [earlier, self.days[0]]

    def rows(self, count: int, seed: int, scale: float = 1.0, of: Any = None) -> Path:
        """Measure random poses."""
        q = self.true.sample(count, seed)
        x, _ = (of or self.true).measure(q, rng=np.random.default_rng(seed), tool=self.tool)
        path = self.folder / f"rows {seed} {scale:.3f}.csv"
        self.sim.write_csv(path, self.true, q, x * scale)
        return path

    def error(self, model: CalibratedModel) -> float:
        """Return the RMS position error of a model at other poses, after a rigid fit [mm]."""
        x, _ = self.true.tip(self.judged, self.tool)
        return position_error(model, self.judged, x)

    def happen(self, month: int) -> None:
        """Apply the changes of a month to the arm and its set-up."""
        self.true.perturb[1] = np.deg2rad(0.005 * month)
        if month == 7:
            self.true.perturb[2] = np.deg2rad(0.05)
        if month == 9:
            turn = Rotation.from_euler("xyz", [2, -1, 100], degrees=True).as_matrix()
            self.true.base = (turn, np.array([2.0, 1.0, 0.3]))
        if month == 10:
            self.tool = (0.08, 0.02, 0.10)
        if month in WANTED:
            self.since = []

    def month(self, month: int) -> tuple[set[str], float, list[float]]:
        """Import the session of a month; return the named changes, and the errors [mm] of all compared models."""
        self.happen(month)
        rows = self.rows(10, 100 + month)
        before = self.cell.model
        assert before is not None
        entry = self.cell.add_session(rows, day=self.days[month])
        self.since.append(entry.day)
        self.wrong_steps += self.cell.status().step.state != "session_not_judged"
        found = self.cell.monitor().sessions_of_call[-1]
        named = {one["what"] for one in found.to_json()["moved"]}
        others = [self.error(before)]
        others += [self.error(recalibrate(before, self.cell.sessions.rows_of_file(entry)).model)]
        if self.cell.status().step.state in ("moved", "older_than_evidence"):
            self.cell.recalibrate()
        # a session of last winter is verified again on this day
        self.wrong_steps += self.cell.status().step.state not in ("up_to_date", "verification_due")
        sessions = [one for one in self.cell.history.sessions() if one.day in self.since]
        if sum(one.rows for one in sessions) >= 30:
            others.append(
                self.error(calibrate(self.cell.robot, self.cell.sessions.rows_of(sessions), QUIET).model)
            )
        in_use = self.cell.model
        assert in_use is not None
        return named, self.error(in_use), others

    def refuses(self, path: Path, day: str) -> bool:
        """Return whether a wrong session is refused."""
        try:
            self.cell.add_session(path, day=day)
        except PisigmaError:
            return True
        return False


def sim_folder(sim: Any) -> Path:
    """Return the folder of the simulator."""
    return Path(sim.__file__).parent


def main() -> None:
    """Simulate the years of several seeds and print the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--arm", default="irb120")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="First seed.")
    parser.add_argument("--months", action="store_true", help="Print every month.")
    stated = parser.parse_args()
    sim = import_simulator(stated.folder)
    named, refused, ratios, alarms, wrong = dict.fromkeys(WANTED, 0), 0, [], 0, 0
    for seed in range(stated.first, stated.first + stated.seeds):
        with tempfile.TemporaryDirectory() as folder:
            year = Year(sim, stated.arm, seed, Path(folder))
            for month in range(1, 13):
                found, error, others = year.month(month)
                if month in WANTED:
                    named[month] += WANTED[month] in found
                alarms += len(found - {"joint 2", WANTED.get(month, "joint 2"), "base", "tool"})
                ratios.append(error / min(others))
                if stated.months:
                    judged = ", ".join(f"{one:.3f}" for one in (error, *others))
                    print(
                        f"  month {month:2}: {','.join(sorted(found)) or 'nothing'}; RMS {judged} mm",
                        file=sys.stderr,
                    )
                if month == 4:
                    other = sim.True_("kr10" if stated.arm != "kr10" else "irb120", seed=seed)
                    refused += year.refuses(year.rows(10, 500, of=other), year.days[month])
                if month == 6:
                    refused += year.refuses(year.rows(10, 501, 1 / 25.4), year.days[month])
            wrong += year.wrong_steps
        print(
            f"seed {seed}: named {named}, refused {refused}, wrong steps {wrong}, ratio {np.median(ratios):.2f}",
            file=sys.stderr,
        )
    for month, what in WANTED.items():
        print(f"month {month}, {what}: named in {named[month]} of {stated.seeds} years")
    print(
        f"wrong sessions refused: {refused} of {2 * stated.seeds}; joints named that have not moved: {alarms}"
    )
    print(
        f"model in use over the best of three: median {np.median(ratios):.2f}, 90 % {np.quantile(ratios, 0.9):.2f}"
    )


if __name__ == "__main__":
    main()
