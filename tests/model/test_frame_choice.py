"""Poses of the target and in the frame that a user names."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

import pisigma
from pisigma.files.errors import ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.model.folder.model_folder import load_model
from pisigma.model.frame_choice import several_names, warnings_without_rows, with_frame_and_target
from pisigma.model.inverse.corrected_ik import CorrectedIK

Q = np.array([0.3, 0.2, -0.1, 0.2, 0.5, 0.3])


@pytest.fixture(scope="module")
def folder(repository: Path) -> Path:
    return repository / "models" / "fanuc_burakov"


@pytest.fixture(scope="module")
def model(folder: Path) -> CalibratedModel:
    return load_model(folder)


def row(frame: str = "", target: str = "") -> Measurements:
    return Measurements(q=torch.tensor(Q)[None], frame=(frame,), target=(target,))


def test_poses_of_every_target(folder: Path, model: CalibratedModel) -> None:
    ik = pisigma.load(folder)
    assert dict(several_names(model)) == {"target": ("A", "B", "C")}
    assert len(ik.warnings) == 1
    for name in ("A", "B", "C"):
        of_target = ik.for_target(name)
        T = of_target.forward(Q)
        assert_close(T, poses_of_rows(model, row(target=name))[0], atol=1e-14)
        assert_close(of_target(T, near=Q).q, Q, atol=1e-9)
        expected = float(sigma_of_rows(model, row(target=name)).norm())
        assert_close(float(of_target.accuracy(Q)), expected, rtol=1e-12)
        assert of_target.warnings == ()


def test_poses_in_every_frame(model: CalibratedModel) -> None:
    moved = np.array([0.5, -0.2, 0.1, 0.3, 0.02, -0.01])
    bases = {name: {**getattr(model, name), "moved": moved} for name in ("bases", "hybrid_bases")}
    ik = CorrectedIK(replace(model, uncertainty=None, **bases))
    assert len(ik.warnings) == 2
    for name in ("", "moved"):
        T = ik.for_target("C", frame=name).forward(Q)
        assert_close(T, poses_of_rows(ik.model, row(name, "C"))[0], atol=1e-14)


def test_the_task_is_kept(model: CalibratedModel) -> None:
    ik = CorrectedIK(model).for_task(ignore_axes=("yaw",))
    of_target = ik.for_target("B")
    assert of_target.task_axes == ik.task_axes
    assert of_target(of_target.forward(Q), near=Q).ignored_axes == ("yaw",)


def test_a_network_is_valid_only_for_its_own_target(model: CalibratedModel, repository: Path) -> None:
    network = load_model(repository / "models" / "kiro3").network
    trained = replace(model, hybrid=None, calibrated=None, network=network)
    assert with_frame_and_target(trained, target="A").tools.keys() == {"A"}
    with pytest.raises(ModelError) as caught:
        with_frame_and_target(trained, target="B")
    assert caught.value.value == trained.kind
    assert len(warnings_without_rows(trained)) == 1


@pytest.mark.parametrize("names", [{"target": "D"}, {"frame": "cell"}])
def test_unknown_names_are_refused(model: CalibratedModel, names: dict[str, str]) -> None:
    with pytest.raises(ModelError) as caught:
        CorrectedIK(model).for_target(**names)
    assert caught.value.value in ("D", "cell")
    assert caught.value.option == next(iter(names))
