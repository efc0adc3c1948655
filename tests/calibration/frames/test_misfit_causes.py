"""The cause of a bad hand-eye fit: arm, camera, board or joint readings, by the evidence of the images."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.camera_cell import BOARD, CAMERA, NOISE, camera_cell
from testing.closeness import assert_close
from testing.models import no_type_checker

from pisigma.calibration.frames.frame_fit import fit_frames
from pisigma.calibration.frames.misfit_causes import misfit_causes
from pisigma.estimation.alternatives import CLEAR, Cause, FitResiduals
from pisigma.measurement.camera.camera import USUAL_DEVIATIONS
from pisigma.measurement.camera.image_rows import image_measurements

IMAGES = 12
SMALL = (0.0, 0.0)


def causes_of(kind: str, seed: int) -> tuple[Cause, ...]:
    """Return the causes of a hand-eye fit with one thing wrong."""
    length, angle = (3e-4, np.deg2rad(0.05)) if kind == "arm" else SMALL
    with no_type_checker():
        cell, rng = camera_cell(IMAGES, seed, length=length, angle=angle), np.random.default_rng(seed)
        off = rng.standard_normal(9) * USUAL_DEVIATIONS * (15 if kind == "camera" else 1)
        board = replace(BOARD, square=BOARD.square * (1.005 if kind == "board" else 1))
        q = cell.images.q
        moved = {"joint zeros": rng.normal(0, 2e-3, 6), "joint noise": rng.normal(0, 1e-3, q.shape)}
        images = replace(cell.images, q=q + torch.from_numpy(moved.get(kind, np.zeros(6))))
        camera = CAMERA.with_intrinsics(CAMERA.intrinsics + off)
        rows = image_measurements(images, camera, board, False, NOISE.repeatability)
        return misfit_causes(fit_frames(cell.nominal, rows, "hand-eye"))


@pytest.mark.parametrize("kind", ["arm", "joint zeros", "joint noise", "camera", "board"])
def test_cause_is_named(kind):
    first, *_ = causes_of(kind, 1)
    assert first.name == kind
    assert first.is_supported
    assert first.log_bayes_factor > 2 * CLEAR
    assert 0.3 < first.explained_share <= 1.0


def test_no_fault_is_named_for_valid_rows():
    causes = causes_of("nothing", 2)
    assert not any(one.is_supported for one in causes)
    assert all(one.log_bayes_factor < CLEAR for one in causes)


def test_evidence_is_that_of_the_marginal_likelihood():
    rng = np.random.default_rng(0)
    fitted, Z = torch.from_numpy(rng.normal(size=(30, 4))), torch.from_numpy(rng.normal(size=(30, 3)))
    y = torch.from_numpy(rng.normal(size=30)) + Z @ torch.tensor([2.0, -1.0, 1.5]).double()
    none = torch.zeros(30, dtype=torch.bool)
    residuals = FitResiduals.from_fit(y, fitted, Z[:, :0], none, False, {"wrong": Z, "other": Z.flip(0)})
    wrong, other = residuals.compare()
    assert (wrong.name, wrong.is_supported, other.is_supported) == ("wrong", True, False)
    # the same with a wide prior of what was fitted instead of the projection
    sizes, noise = torch.logspace(-3, 1.5, 28).double(), torch.logspace(-2, 2, 41).double()

    def log_likelihood(size: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
        size, factor = size[:, None, None, None], factor[None, :, None, None]
        V = 1e8 * fitted @ fitted.t() + size**2 * Z @ Z.t() + factor**2 * torch.eye(30).double()
        return torch.distributions.MultivariateNormal(torch.zeros(30).double(), V).log_prob(y)

    nothing = log_likelihood(torch.zeros(1).double(), noise).logsumexp((0, 1))
    expected = log_likelihood(sizes, noise).logsumexp((0, 1)) - np.log(len(sizes)) - nothing
    assert_close(wrong.log_bayes_factor, expected, atol=1e-3)
