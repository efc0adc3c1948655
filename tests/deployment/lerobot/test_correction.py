"""Frames of LeRobot are corrected by the offsets of the joints and keep shape, type and order."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow
import pytest
import torch
from pyarrow import parquet
from testing.closeness import assert_close
from testing.lerobot_arm import DATA_SETS, NAMES, RANGES, ZEROS, so101_model
from testing.refusals import refused

import pisigma
from pisigma.deployment.lerobot.dataset import RECORD, STATISTICS, correct_lerobot_dataset
from pisigma.files.errors import MeasurementError, OutputError
from pisigma.robot.kinematics.forward import forward_kinematics

DEGREE = 4096 / 4095
"""LeRobot's degrees per degree."""
FRAMES = np.random.default_rng(3).uniform(-50, 50, (7, 2, 6))


@pytest.fixture
def correction(model_folder):
    return pisigma.LeRobotCorrection.load(model_folder, NAMES, "degrees")


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
@pytest.mark.parametrize("kind", [np.float32, np.float64, torch.float32])
def test_true_values_add_the_zeros_and_keep_shape_and_type(correction, batch, kind):
    random = np.random.default_rng(0).uniform(-50, 50, (*batch, 6))
    frames = torch.tensor(random, dtype=kind) if kind is torch.float32 else random.astype(kind)
    there = correction.true_values(frames)
    assert type(there) is type(frames)
    assert there.dtype == frames.dtype
    assert_close(there, random + DEGREE * np.array([*ZEROS, 0]), atol=1e-5)
    assert_close(correction.commands(there), frames, atol=1e-5)


def test_an_observation_keeps_its_other_entries_and_their_order(correction):
    image = np.zeros((2, 2, 3), np.uint8)
    frame = {"front": image, **dict(zip(NAMES, FRAMES[0, 0].tolist(), strict=True)), "task": "reach"}
    there = correction.true_values(frame)
    assert list(there) == list(frame)
    assert there["front"] is image
    assert there["task"] == "reach"
    assert_close([there[name] for name in NAMES], correction.true_values(FRAMES[0, 0]))


def test_the_nominal_arm_at_true_values_is_where_the_real_arm_was(correction):
    nominal, real = so101_model().robot, so101_model().identified
    q = torch.from_numpy(correction.joint_values(FRAMES))
    assert_close(correction.poses(FRAMES), forward_kinematics(real, q), atol=1e-12)
    there = torch.from_numpy(correction.joint_values(correction.true_values(FRAMES)))
    assert_close(forward_kinematics(nominal, there), forward_kinematics(real, q), atol=1e-9)


def test_normalized_values_span_the_ranges_of_the_motors(model_folder, calibration):
    of_range = pisigma.LeRobotCorrection.load(model_folder, NAMES, "normalized", calibration)
    low, high = np.array(RANGES[:5]).T
    assert_close(of_range.joint_values(np.full(6, 100.0)), (high - low) / 2 * 2 * np.pi / 4096, rtol=1e-12)
    assert_close(of_range.value_offsets[:5] * (high - low) / 200 * 360 / 4096, ZEROS, atol=1e-9)


def test_values_in_another_order_and_of_one_arm_of_two(model_folder, correction):
    names = [f"left_{name}" for name in reversed(NAMES)] + [f"right_{name}" for name in NAMES]
    pair = pisigma.LeRobotCorrection.load(model_folder, names, "degrees", prefix="left_")
    assert_close(pair.value_offsets, [*reversed(correction.value_offsets), *[0.0] * 6])


@pytest.mark.usefixtures("without_type_checker")
def test_what_is_ambiguous_is_refused(model_folder, calibration, correction):
    load = pisigma.LeRobotCorrection.load
    with refused(MeasurementError, option="calibration", value="shoulder_pan"):
        load(model_folder, NAMES, "normalized")
    with refused(MeasurementError, option="units", value="ticks"):
        load(model_folder, NAMES, "ticks")
    with refused(MeasurementError, option="names"):
        load(model_folder, ["joint_1", *NAMES[1:]], "degrees")
    with refused(MeasurementError, option="frames", value="(7, 2, 5)"):
        correction.true_values(FRAMES[..., :5])
    with refused(MeasurementError, option="frames", value="int64"):
        correction.true_values(FRAMES.astype(int))
    document = json.loads(calibration.read_text())
    document["elbow_flex"]["drive_mode"] = 1
    calibration.write_text(json.dumps(document))
    with refused(MeasurementError, option="calibration", value="elbow_flex"):
        load(model_folder, NAMES, "normalized", calibration)


def columns(folder: Path) -> dict[str, np.ndarray]:
    """Return all columns of the frames of a data set, in the order of the files."""
    tables = [parquet.read_table(file) for file in sorted(folder.glob("data/chunk-*/*.parquet"))]
    return {
        name: np.concatenate([np.array(table.column(name).to_pylist()) for table in tables])
        for name in tables[0].column_names
    }


@pytest.mark.parametrize("layout", ["v2.1", "v3.0"])
def test_a_data_set_is_corrected(layout, model_folder, tmp_path, correction):
    source = DATA_SETS / layout
    result = correct_lerobot_dataset(source, model_folder, tmp_path / "new", "degrees")
    assert result.frames == 12
    before, after = columns(source), columns(result.folder)
    assert list(before) == list(after)
    for name, values in before.items():
        moved = name in ("action", "observation.state")
        assert_close(after[name], values + correction.value_offsets if moved else values, atol=1e-5)
    for file in sorted(source.rglob("*.parquet")):
        old, new = parquet.read_schema(file), parquet.read_schema(tmp_path / "new" / file.relative_to(source))
        assert new.equals(old, check_metadata=True)
    version = json.loads((result.folder / RECORD).read_text())[""]["action"]
    assert version["model"] == "so101"
    assert len(version["sha256"]) == 64
    assert_close([version["offsets_deg"][name.removesuffix(".pos")] for name in NAMES[:5]], ZEROS, atol=1e-9)


def episode_statistics(folder: Path) -> list[dict[str, np.ndarray]]:
    """Return the statistics of `action` of all frames (if stated) and of every episode."""
    found = []
    for file in (folder / "meta").glob("*stats*"):
        for line in [file.read_text()] if file.suffix == ".json" else file.read_text().splitlines():
            document = json.loads(line)
            found.append(document.get("stats", document)["action"])
    for file in sorted(folder.glob("meta/episodes/chunk-*/*.parquet")):
        for row in parquet.read_table(file).to_pylist():
            found.append({key.split("/")[-1]: row[key] for key in row if key.startswith("stats/action/")})
    return [{key: np.array(value) for key, value in one.items()} for one in found]


@pytest.mark.parametrize("layout", ["v2.1", "v3.0"])
def test_statistics_move_with_the_values(layout, model_folder, tmp_path, correction):
    correct_lerobot_dataset(DATA_SETS / layout, model_folder, tmp_path / "new", "degrees")
    before, after = episode_statistics(DATA_SETS / layout), episode_statistics(tmp_path / "new")
    assert len(before) == len(after) > 1
    for old, new in zip(before, after, strict=True):
        assert set(old) == set(new) >= {"mean", "std", "min", "max", "count"}
        for key, value in old.items():
            assert_close(
                new[key], value + correction.value_offsets if key in STATISTICS else value, atol=1e-9
            )


def test_a_data_set_is_not_corrected_twice_nor_overwritten(model_folder, tmp_path):
    correct_lerobot_dataset(DATA_SETS / "v3.0", model_folder, tmp_path / "new", "degrees")
    with refused(MeasurementError, file="pisigma.json"):
        correct_lerobot_dataset(tmp_path / "new", model_folder, tmp_path / "again", "degrees")
    with refused(OutputError, option="out"):
        correct_lerobot_dataset(DATA_SETS / "v3.0", model_folder, tmp_path / "new", "degrees")
    assert not (tmp_path / "again").exists()


def test_another_layout_and_unnamed_values_are_refused(tmp_path, model_folder):
    info = json.loads((DATA_SETS / "v3.0" / "meta" / "info.json").read_text())
    (tmp_path / "meta").mkdir()
    for change in ({"codebase_version": "v1.6"}, {"features": {"action": {"names": None}}}):
        (tmp_path / "meta" / "info.json").write_text(json.dumps(info | change))
        with refused(MeasurementError, file="info.json"):
            correct_lerobot_dataset(tmp_path, model_folder, tmp_path / "new", "degrees")


def pair_of_arms(folder):
    """Write a data set of two arms, whose frames are those of v2.1 twice."""
    shutil.copytree(DATA_SETS / "v2.1", folder)
    info = json.loads((folder / "meta" / "info.json").read_text())
    for key in ("action", "observation.state"):
        info["features"][key] |= {
            "shape": [12],
            "names": [f"{side}_{name}" for side in ("left", "right") for name in NAMES],
        }
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "meta" / "episodes_stats.jsonl").unlink()
    for file in folder.glob("data/chunk-*/*.parquet"):
        table = parquet.read_table(file)
        for key in ("action", "observation.state"):
            doubled = [[*row, *row] for row in table.column(key).to_pylist()]
            table = table.set_column(
                table.column_names.index(key), key, pyarrow.array(doubled, pyarrow.list_(pyarrow.float32()))
            )
        parquet.write_table(table, file)
    return folder


def test_both_arms_of_a_pair_are_corrected_one_after_the_other(model_folder, correction, tmp_path):
    source = pair_of_arms(tmp_path / "pair")
    with refused(MeasurementError, option="prefix"):
        correct_lerobot_dataset(source, model_folder, tmp_path / "left", "degrees")
    left = correct_lerobot_dataset(source, model_folder, tmp_path / "left", "degrees", prefix="left_").folder
    both = correct_lerobot_dataset(left, model_folder, tmp_path / "both", "degrees", prefix="right_").folder
    before, after = columns(source), columns(both)
    assert_close(after["action"], before["action"] + np.tile(correction.value_offsets, 2), atol=1e-5)
    assert set(json.loads((both / RECORD).read_text())) == {"left_", "right_"}
    for prefix in ("left_", "right_", "left_arm_"):
        with refused(MeasurementError, file="pisigma.json"):
            correct_lerobot_dataset(both, model_folder, tmp_path / "again", "degrees", prefix=prefix)


@pytest.mark.parametrize("broken", ["meta/stats.json", "meta/episodes/chunk-000/file-000.parquet"])
def test_files_that_cannot_be_read_or_written_are_refused(broken, model_folder, tmp_path):
    shutil.copytree(DATA_SETS / "v3.0", tmp_path / "old")
    (tmp_path / "old" / broken).write_text("{")
    with refused(MeasurementError, file=Path(broken).name):
        correct_lerobot_dataset(tmp_path / "old", model_folder, tmp_path / "new", "degrees")
    (tmp_path / "file").touch()
    with refused(OutputError, file="new"):
        correct_lerobot_dataset(DATA_SETS / "v3.0", model_folder, tmp_path / "file" / "new", "degrees")


@pytest.mark.parametrize("kind", [float, np.float64, np.float32, torch.tensor, np.atleast_1d])
def test_values_by_name_keep_their_type_and_integers_are_refused(kind, correction):
    frame = {name: kind(10.0) for name in NAMES}
    moved = correction.true_values(frame)
    for name, offset in zip(NAMES, correction.value_offsets, strict=True):
        assert type(moved[name]) is type(frame[name])
        assert getattr(moved[name], "dtype", None) == getattr(frame[name], "dtype", None)
        assert_close(np.squeeze(moved[name]), 10.0 + offset, atol=1e-5)
    for integer in (10, True, np.int64(10), torch.tensor(10)):
        with refused(MeasurementError, option=NAMES[1]):
            correction.true_values(frame | {NAMES[1]: integer})


def test_velocities_and_torques_are_not_changed(model_folder, correction):
    names = [f"{name.removesuffix('.pos')}{kind}" for name in NAMES for kind in (".pos", ".vel", ".torque")]
    wide = pisigma.LeRobotCorrection.load(model_folder, names, "degrees")
    expected = np.zeros((6, 3))
    expected[:, 0] = correction.value_offsets
    assert_close(wide.value_offsets, expected.reshape(-1))
