"""A folder predicts the same as the model in memory, for any features in any order."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file
from testing.coupled import coupled_robot
from testing.identified import hybrid_model
from testing.refusals import refused
from testing.same_model import differences

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import ModelError
from pisigma.joint_correction import registry
from pisigma.joint_correction.backlash import Backlash
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.coupled_series import CoupledSeries
from pisigma.joint_correction.feature import AbstractFeature, FeatureSection
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.shared_features import SinesCosines
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.distance import ANCHOR_COLUMNS
from pisigma.measurement.sensors.intrinsics import CAMERA_UNITS
from pisigma.measurement.sensors.sensor import UnknownGroup
from pisigma.measurement.sensors.socket import SOCKET_COLUMNS
from pisigma.model.accuracy import parameter_posterior, sigma_of_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.folder.upgrade import upgrade_folder
from pisigma.model.inverse.written_model import check_written, write_model
from pisigma.model.model_posterior import ModelPosterior
from pisigma.robot import Robot

pytestmark = pytest.mark.usefixtures("without_type_checker")


class OutsideSection(FeatureSection):
    """Section of a plug-in's feature in a folder."""

    factor: float


class Outside(AbstractFeature):
    """sin and cos of a multiple of the sum of a joint's and the first joint's angle, as in a plug-in."""

    name = "outside"
    section = OutsideSection
    group_names = ("sines", "cosines")

    def __init__(self, robot: Robot, factor: float) -> None:
        """Two columns per joint."""
        super().__init__(robot)
        self.factor = factor
        self.used = torch.ones(robot.dof, 2, dtype=torch.bool)
        self.group = torch.tensor([[0, 1]] * robot.dof)

    def columns(self, state: JointState) -> torch.Tensor:
        """See `AbstractFeature.columns`."""
        angle = self.factor * (state.q + state.q[..., :1])
        return torch.stack([angle.sin(), angle.cos()], -1)


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    monkeypatch.setitem(registry.FEATURES, Outside.name, Outside)


ROBOTS = {"kiro4": Robot.load("kiro4"), "coupled": coupled_robot()}
NAMES = ("", "floor", "01", "1e3", "null", "yes")


def feature(name: str, robot: Robot) -> AbstractFeature:
    """A feature of a robot by its name."""
    made: dict[str, Callable[[], AbstractFeature]] = {
        "series": lambda: FourierSeries(robot, 3),
        "series, fine": lambda: FourierSeries(robot, 12, fine=True),
        "gravity": lambda: GravityTorques(robot, (0.6, 0.0, -0.8)),
        "conditions": lambda: ConditionFeatures(robot, ("payload_kg",), (2.0,), (1.0,), ((0.0, 4.0),)),
        "backlash": lambda: Backlash(robot),
        "lines": lambda: GearLines(robot, ((5, 9), *[()] * (robot.dof - 2), (7,))),
        "sines": lambda: SinesCosines(robot),
        "coupling": lambda: CoupledSeries(robot),
        "outside": lambda: Outside(robot, 1.3),
        "products": lambda: InputProducts(robot),
    }
    return made[name]()


FEATURES = (
    *("series", "series, fine", "gravity", "conditions", "backlash"),
    *("lines", "sines", "coupling", "outside", "products"),
)


def groups_of(names: Sequence[str], frames: Sequence[str]) -> tuple[UnknownGroup, ...]:
    """Unknown sensor parameters in the first and the last frame."""
    of = {
        "anchor": (ANCHOR_COLUMNS, ("wall", "null"), {}),
        "socket": (SOCKET_COLUMNS, ("plate/1", "plate/0", "01"), {}),
        "board": (("scale",), ("no",), {"scale": "1"}),
        "camera": (tuple(CAMERA_UNITS), ("yes", "0"), CAMERA_UNITS),
    }
    chosen = ((name, *of[name]) for name in names)
    return tuple(
        UnknownGroup(name, columns, owners, (frames[0], *[frames[-1]] * (len(owners) - 1)), units=units)
        for name, columns, owners, units in chosen
    )


GROUPS = groups_of(("anchor", "socket", "board"), ("floor", "wall"))


def model_with(
    chosen: Sequence[str],
    groups: Sequence[UnknownGroup] = (),
    frames: Sequence[str] = ("",),
    targets: Sequence[str] = ("",),
    seed: int = 0,
    robot: Robot = ROBOTS["kiro4"],
) -> CalibratedModel:
    """A hybrid with random numbers, its weights in the order in which features were chosen."""
    generator = np.random.default_rng(seed)
    features = [feature(name, robot) for name in chosen]
    linear = [one for one in features if not isinstance(one, InputProducts)]
    factors = torch.zeros(0)
    for product in (one for one in features if isinstance(one, InputProducts)):
        weights = 1e-4 * torch.from_numpy(generator.normal(size=int(product.used.sum())))
        factors = product.factors(weights)
    model = hybrid_model(
        "kiro4", linear, orders=(2,) * (factors.shape[1] // 2 if len(factors) else 0), robot=robot
    )
    if len(factors):
        with torch.no_grad():
            model.hybrid.correction.weight.copy_(factors)
            model.hybrid.correction.bias.zero_()
    bases, tools = (
        {name: frame + 0.1 * k for k, name in enumerate(names)}
        for names, frame in ((frames, model.robot.base), (targets, model.robot.tool))
    )
    space = ParameterSpace(model.nominal, tuple(frames), tuple(targets), tuple(groups))
    unknowns = {
        group.name: {owner: generator.normal(size=len(group.columns)) for owner in group.owners}
        for group in groups
    }
    geometry = IdentifiedGeometry(model.hybrid.robot, bases, tools, unknowns)
    size = len(space.parameters) + sum(int(one.used.sum()) for one in features)
    root = 1e-4 * torch.from_numpy(generator.normal(size=(size, 7)))
    root[3] = 0.0
    return replace(
        model,
        bases=bases,
        tools=tools,
        hybrid_bases=bases,
        hybrid_tools=tools,
        uncertainty=PositionUncertainty(
            space,
            geometry,
            tuple(features),
            CovarianceRoot(root),
            1.5,
            CalibrationNoise({"position": 1e-5}, {"position": 2e-5}),
        ),
    )


@given(
    robot=st.sampled_from(sorted(ROBOTS)),
    chosen=st.lists(st.sampled_from(FEATURES), unique_by=lambda name: name.split(",")[0], min_size=1),
    groups=st.lists(st.sampled_from(("anchor", "socket", "board", "camera")), unique=True),
    frames=st.lists(st.sampled_from(NAMES), unique=True, min_size=1, max_size=3),
    targets=st.lists(st.sampled_from(NAMES), unique=True, min_size=1, max_size=3),
    seed=st.integers(0, 99),
)
@settings(
    max_examples=10,
    deadline=None,
    phases=(Phase.generate,),
    suppress_health_check=list(HealthCheck),
)
def test_a_folder_predicts_the_same_as_the_model(
    tmp_path_factory, robot, chosen, groups, frames, targets, seed
):
    folder = tmp_path_factory.mktemp("model")
    model = model_with(chosen, groups_of(groups, frames), frames, targets, seed, ROBOTS[robot])
    write_model(model, folder)
    loaded = load_model(folder)
    assert differences(model, loaded) == []
    assert differences(parameter_posterior(model), parameter_posterior(loaded)) == []
    before, after = ModelPosterior.from_model(model), ModelPosterior.from_model(loaded)
    assert torch.equal(after.rms_weights, before.rms_weights)
    start = 0
    for one in before.features:
        count = int(one.used.sum())
        if not isinstance(one, InputProducts):
            number = [own.name for own in model.hybrid.correction.features].index(one.name)
            learned = model.hybrid.correction.linear[number][one.used]
            assert torch.equal(after.weights[start : start + count], learned)
        start += count


def as_format_4(folder, kind: str = "hybrid_calibration") -> None:
    """Write the description without the order, and the root in float32, as in format 4."""
    tensors = load_file(folder / "model.safetensors")
    tensors["uncertainty.root"] = tensors["uncertainty.root"].float()
    save_file(tensors, folder / "model.safetensors")
    document = yaml.load(
        (folder / "model.yaml").read_text().rsplit("sha256: ", 1)[0], Loader=yaml.CSafeLoader
    )
    known = document["uncertainty"]
    groups = {group.pop("name"): group for group in known.pop("unknowns")}
    for name in ("socket", "anchor"):
        known[f"{name}s"] = groups.pop(name, {"owners": []})["owners"]
    known["others"], known["products"] = groups, "products" in known.pop("features")
    digest = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    document |= {"format": 4, "kind": kind, "weights_sha256": digest, "metrics": {"parameters": []}}
    text = yaml.dump(document, Dumper=yaml.CSafeDumper, sort_keys=False)
    (folder / "model.yaml").write_text(f"{text}sha256: {hashlib.sha256(text.encode()).hexdigest()}\n")


@pytest.mark.parametrize(
    "chosen", [("gravity", "series", "products", "lines"), ("gravity", "products"), ("series", "lines")]
)
def test_an_earlier_folder_is_read_in_the_order_in_which_it_was_written(tmp_path, chosen):
    model = model_with(chosen, GROUPS, ("floor", "wall"))
    save_model(model, tmp_path)
    as_format_4(tmp_path)
    upgrade_folder(tmp_path, check_written)
    loaded = load_model(tmp_path)
    assert [one.name for one in loaded.uncertainty.features] == list(chosen)
    assert [group.name for group in loaded.uncertainty.space.unknowns] == [group.name for group in GROUPS]
    rows = Measurements(q=model.starts, frame=("wall",) * len(model.starts))
    there = sigma_of_rows(loaded, rows) / sigma_of_rows(model, rows)
    assert float((there - 1).abs().max()) < 1e-5


def test_an_earlier_folder_whose_rows_were_added_in_another_order_is_refused(tmp_path):
    save_model(model_with(("products", "lines")), tmp_path)
    as_format_4(tmp_path, "recalibration")
    before = {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()}
    with refused(ModelError, expected="an uncertainty whose weights are in a known order"):
        upgrade_folder(tmp_path, check_written)
    assert {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()} == before


def test_a_folder_that_differs_from_the_model_is_a_defect(tmp_path):
    model = model_with(("products", "lines"))
    write_model(model, tmp_path)
    known = model.uncertainty
    swapped = replace(known, features=known.features[::-1])
    with pytest.raises(AssertionError, match="deviations"):
        check_written(replace(model, uncertainty=swapped), tmp_path)
    turned = replace(model, hybrid=replace(model.hybrid, robot=model.robot))
    with pytest.raises(AssertionError, match="poses"):
        check_written(turned, tmp_path)
