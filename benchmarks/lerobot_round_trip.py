"""Calibration files and data sets that LeRobot, in its own environment, writes, pisigma corrects and LeRobot reads.

`python benchmarks/lerobot_round_trip.py --lerobot /path/to/python` needs a Python with lerobot 0.3 or later.
LeRobot writes a calibration file and a data set, pisigma corrects both for an SO-101 whose zeros are off by 5 to 17
deg, and LeRobot reads them: the calibration file has to be equal to the digit, LeRobot's own conversion of ticks has to
show the zeros, and frames have to keep shape, type and order. Finally, the number of frames that are corrected per
minute is printed.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
NAMES = [f"{name}.pos" for name in MOTORS]
ZEROS = np.array([0.0, 12.0, -7.0, 5.5, 0.0])
EPISODES, FRAMES = 50, 200
TICKS = (1200, 2047, 2900)


def lerobot_bus(path: Path) -> Any:
    """Return LeRobot's bus of an SO-101 with the calibration of a file; nothing is connected."""
    import draccus
    from lerobot.motors import Motor, MotorCalibration, MotorNormMode
    from lerobot.motors.feetech import FeetechMotorsBus

    with path.open() as file, draccus.config_type("json"):
        calibration = draccus.load(dict[str, MotorCalibration], file)
    motors = {name: Motor(n, "sts3215", MotorNormMode.DEGREES) for n, name in enumerate(MOTORS, start=1)}
    bus = object.__new__(FeetechMotorsBus)  # the constructor would open the serial port
    bus.motors, bus.calibration = motors, calibration
    bus._id_to_model_dict = {motor.id: motor.model for motor in motors.values()}
    bus._id_to_name_dict = {motor.id: name for name, motor in motors.items()}
    return bus


def lerobot_writes(folder: Path) -> None:
    """Write a calibration file and a data set with LeRobot."""
    import draccus
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.motors import MotorCalibration

    calibration = {
        name: MotorCalibration(n, 0, 11 * n - 40, 700 + n, 3300 - n) for n, name in enumerate(MOTORS, start=1)
    }
    with (folder / "before.json").open("w") as file, draccus.config_type("json"):
        draccus.dump(calibration, file, indent=4)
    features = {
        key: {"dtype": "float32", "shape": (6,), "names": NAMES} for key in ("action", "observation.state")
    }
    data = LeRobotDataset.create(
        "pisigma/so101", fps=30, features=features, root=folder / "data", use_videos=False
    )
    random = np.random.default_rng(0)
    for _ in range(EPISODES):
        for values in random.uniform(-60, 60, (FRAMES, 2, 6)).astype(np.float32):
            data.add_frame({"action": values[0], "observation.state": values[1], "task": "reach"})
        data.save_episode()
    data.finalize()


def lerobot_reads(folder: Path) -> dict[str, Any]:
    """Return what LeRobot reads in the corrected files."""
    import draccus
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    found: dict[str, Any] = {}
    for name in ("before", "after"):
        bus = lerobot_bus(folder / f"{name}.json")
        with (folder / f"{name}_again.json").open("w") as file, draccus.config_type("json"):
            draccus.dump(bus.calibration, file, indent=4)
        found[name] = [list(bus._normalize(dict.fromkeys(range(1, 7), ticks)).values()) for ticks in TICKS]
    before = LeRobotDataset("pisigma/so101", root=folder / "data")
    after = LeRobotDataset("pisigma/so101", root=folder / "corrected")
    frames = [(before[index], after[index]) for index in range(0, len(before), 97)]
    found["frames"] = len(after)
    found["same"] = all(
        list(a) == list(b)
        and all(
            type(a[key]) is type(b[key])
            and getattr(a[key], "shape", ()) == getattr(b[key], "shape", ())
            and getattr(a[key], "dtype", None) == getattr(b[key], "dtype", None)
            for key in a
        )
        for a, b in frames
    )
    found["moved"] = {
        key: [(b[key].double() - a[key].double()).tolist() for a, b in frames]
        for key in ("action", "observation.state")
    }
    found["statistics"] = {
        key: (after.meta.stats[key]["mean"] - before.meta.stats[key]["mean"]).tolist()
        for key in found["moved"]
    }
    return found


def write_model(folder: Path) -> Path:
    """Write the model folder of an SO-101 with wrong zeros."""
    import torch

    from pisigma.model.calibrated_model import CalibratedModel
    from pisigma.model.folder.model_folder import save_model
    from pisigma.robot import Robot

    nominal = Robot.load("so101")
    dh = nominal.dh.copy()
    dh[:, 0] += np.deg2rad(ZEROS)
    starts = torch.from_numpy(
        np.random.default_rng(0).uniform(nominal.limits[:, 0], nominal.limits[:, 1], (300, 5))
    )
    calibrated = nominal.with_geometry(dh=dh)
    model = CalibratedModel("so101", "benchmark", nominal, None, None, (), starts, calibrated=calibrated)
    (folder / "model").mkdir()
    save_model(model, folder / "model")
    return folder / "model"


def round_trip(python: str, folder: Path) -> None:
    """Correct what LeRobot writes, and compare what it reads."""
    import pisigma
    from pisigma.deployment.export.export_format import ExportRequest
    from pisigma.deployment.export.registry import export_model

    def lerobot(step: str) -> str:
        command = [python, __file__, "--step", step, "--folder", str(folder)]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]

    model = write_model(folder)
    print(lerobot("write"))
    export_model("lerobot", ExportRequest(model, folder / "export", like=folder / "before.json"))
    (folder / "export" / "before.json").rename(folder / "after.json")
    begin = time.perf_counter()
    result = pisigma.correct_lerobot_dataset(folder / "data", model, folder / "corrected", "degrees")
    seconds = time.perf_counter() - begin
    found = json.loads(lerobot("read"))
    for name in ("before", "after"):
        same = (folder / f"{name}.json").read_text() == (folder / f"{name}_again.json").read_text()
        verdict = "equal to the digit" if same else "DIFFERS"
        print(f"calibration file {name} correction, read and written by LeRobot: {verdict}")
    shown = np.array(found["after"]) - np.array(found["before"])
    error = np.abs(shown[:, :5] - ZEROS * 4096 / 4095).max()
    print(f"zeros by LeRobot's own conversion: largest error {error:.3f} deg")
    offset = result.corrections["action"].value_offsets
    moved = max(np.abs(np.array(rows) - offset).max() for rows in found["moved"].values())
    means = max(np.abs(np.array(mean) - offset).max() for mean in found["statistics"].values())
    print(
        f"data set of {EPISODES} episodes, {found['frames']} frames: shape, type and order "
        f"{'unchanged' if found['same'] else 'CHANGED'}, largest error {moved:.1e} deg, of the means {means:.1e} deg, "
        f"corrected in {seconds:.2f} s"
    )
    frames = np.random.default_rng(1).uniform(-60, 60, (1_000_000, 6)).astype(np.float32)
    begin = time.perf_counter()
    result.corrections["action"].true_values(frames)
    values = time.perf_counter() - begin
    begin = time.perf_counter()
    result.corrections["action"].poses(frames)
    poses = time.perf_counter() - begin
    print(f"1,000,000 frames: joint values {values:.2f} s, poses {poses:.1f} s")


def main() -> None:
    """Run the comparison, or a step of it in LeRobot's Python."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lerobot", default=sys.executable, help="Python that has lerobot")
    parser.add_argument("--step", choices=("write", "read"), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.step == "write":
        lerobot_writes(options.folder)
        from importlib.metadata import version

        print(f"lerobot {version('lerobot')}")
    elif options.step == "read":
        print(json.dumps(lerobot_reads(options.folder)))
    else:
        with tempfile.TemporaryDirectory() as folder:
            round_trip(options.lerobot, Path(folder))


if __name__ == "__main__":
    main()
