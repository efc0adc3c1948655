"""The bad files of `fleet_kills.py` among two good ones, without its kills."""

from hostile.fleet_kills import BAD, faults_of, write_plant
from testing.models import no_type_checker

from pisigma.lifetime.fleet.members import read_fleet
from pisigma.workflow.fleet.one_robot import process_robot, settings_for
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.fleet import FleetSettings


def test_every_bad_file_is_named_with_its_reason(tmp_path):
    write_plant(tmp_path, len(BAD) + 2)
    members = read_fleet(tmp_path / "fleet.csv")
    settings = FleetSettings(calibration=CalibrationSettings(model="geometric"))
    keys, plans = {one.id: "" for one in members}, {one.id: settings_for(settings, one) for one in members}
    with no_type_checker():
        records = [process_robot(one, settings, tmp_path / "out", keys, plans) for one in members]
    assert not faults_of({one.robot: one.reason for one in records if one.reason is not None})
