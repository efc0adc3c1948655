"""What limits a calibration by a camera, and what its images leave open."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import view_of
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.intrinsics import (
    CAMERA_COLUMN,
    INTRINSICS_COLUMN,
    NOISE_COLUMN,
    ImageIntrinsics,
    texts_of,
)
from pisigma.model.stored_starts import nearest_branch
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

FRONTAL = np.deg2rad(12.0)
"""Where nine in ten views are less oblique, the error over the workspace is 1.5 to 3 times that of usual views."""
ONE_BRANCH = 0.95
"""Share of images by one branch of the arm from which on the others count as not measured."""
EXPLAINED = 1.3
"""Images that scatter by less than so many times what their corners explain leave nothing for a model of the arm."""
WIDE = 3.0
"""Deviations of focal lengths [px] from which on the intrinsics are free: the usual calibration leaves 0.5 px."""
CONTRADICTED = 4.0
"""[standard deviations] Intrinsics that come out farther off contradict their calibration."""
POSTURES = 200


class CameraCheck(AbstractCheck):
    """Says which of the known traps of calibrations by cameras this one is in; `benchmarks/camera.py` measures them."""

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        by_corners = checked.rows.measured("corner")
        if not bool(by_corners.any()):
            return
        images, result = checked.rows.select(by_corners), checked.geometric
        for sentence in (
            *view_warnings(images.T[:, 2, 2].abs().clamp(max=1.0).acos().cpu(), images.q, checked.robot),
            *_intrinsics(images, result),
            *_tool(images, checked.rows, result),
            *(
                _limit(images, result) if bool(by_corners.all()) else ()
            ),  # beside other sensors it need not be
        ):
            yield Diagnostic(kind="camera", severity="warning", sentence=sentence)


def view_warnings(
    tilt: Float64[Tensor, " images"], q: Float64[Tensor, "images dof"], robot: Robot
) -> Iterator[str]:
    """Say where views of a board are too frontal, or of one branch of the arm.

    Args:
        tilt: how oblique they are [rad].
        q: joint values [rad or m].
        robot: as drawn.
    """
    most = float(tilt.quantile(0.9))
    if most < FRONTAL:
        yield (
            f"Nine in ten images show the board less than {np.rad2deg(most):.0f} deg oblique, which "
            "hardly determines the distance and the tilt of the camera and doubles the error; take images up to 40 deg "
            "oblique."
        )
    solver = closed_form_solver(robot)
    share = 0.0 if solver is None else _largest_share(nearest_branch(solver, q))
    if share >= ONE_BRANCH:
        yield (
            f"{share:.0%} of the images were taken on one branch of the arm (shoulder, elbow and wrist the same way), "
            "which looks good there and is up to three times worse at other postures; take images on other branches."
        )


def _largest_share(branch: Tensor) -> float:
    return float(torch.bincount(branch).max()) / len(branch)


def _intrinsics(images: Measurements, result: CalibrationResult) -> Iterator[str]:
    """Say where intrinsics are held, free, or far from their calibration."""
    identified = ImageIntrinsics.of(texts_of(images, INTRINSICS_COLUMN))
    cells = zip(texts_of(images, CAMERA_COLUMN), identified.stated, identified.sigma, strict=True)
    first = {camera: (stated, sigma) for camera, stated, sigma in reversed(list(cells)) if camera}
    for camera, (stated, sigma) in sorted(first.items()):
        if not sigma.any():
            yield (
                f"The intrinsics of camera '{camera}' were held as its file states them; off by as much as a usual "
                "calibration leaves, they double the error over the workspace (0.1 mm of a UR5). Free them under their "
                "prior, or check them."
            )
            continue
        free = sigma > 0
        off = (result.unknowns["camera"][camera] - stated)[free] / sigma[free]
        if sigma[0] > WIDE:
            yield (
                f"The intrinsics of camera '{camera}' were free, so a board that is not flat is taken for distortion "
                "(0.3 mm of bow change k1 and the distance); state a calibration of the camera where there is one, and "
                "put the board on glass."
            )
        elif np.abs(off).max() > CONTRADICTED:
            yield (
                f"The images contradict the calibration of camera '{camera}' by {np.abs(off).max():.1f} of its "
                "standard deviations; check that it is of this lens, focus and resolution, and that the board is flat."
            )


def _tool(images: Measurements, rows: Measurements, result: CalibrationResult) -> Iterator[str]:
    """Say that the last joint's row goes with hand and eye, where nothing but images was measured."""
    last = [name for name in result.redundancy.removed if name.endswith(f"_{len(result.robot.joints)}")]
    if last and images.rows == rows.rows:
        yield (
            f"Where the camera (or the board) is on the flange cannot be distinguished from errors of the last joint's "
            f"row ({', '.join(last)}), so a tool that is drawn in the flange's frame is not identified; measure a few "
            "positions of that tool with another sensor, or teach its centre."
        )


def _limit(images: Measurements, result: CalibrationResult) -> Iterator[str]:
    """Say that the images limit the calibration, and what of the predicted error the intrinsics and boards make."""
    problem, view = result.solved.problem, view_of(result.solved.refined)
    number = next(k for k, sensor in enumerate(problem.sensors) if sensor.name == "corner")
    ratio = view.noise[number] / float(torch.as_tensor(images.readings[NOISE_COLUMN]).median())
    if ratio >= EXPLAINED:
        return
    total, shares = _predicted_error(result)
    parts = [f"{share:.0%} of its square from {what}" for what, share in shares.items() if share >= 0.1]
    yield (
        f"The camera is what limits this calibration: its images scatter by {ratio:.2f} times what their corners and "
        f"the repeatability explain, and a position is predicted to {total * 1e3:.2g} mm over the joint space"
        f"{', ' + ' and '.join(parts) if parts else ''}. More images, a larger or nearer board and more pixels improve "
        "it."
    )


def _predicted_error(result: CalibrationResult) -> tuple[float, dict[str, float]]:
    """Predicted RMS error of a position over all postures [m], and which share of its square unknowns make."""
    limits = torch.from_numpy(np.asarray(result.robot.limits)).clamp(-np.pi, np.pi)
    generator = torch.Generator().manual_seed(0)
    draws = torch.rand(POSTURES, len(limits), generator=generator, dtype=torch.float64)
    q = limits[:, 0] + draws * (limits[:, 1] - limits[:, 0])
    J = identification_jacobian(result.robot, q)[1][:, :3, : result.solved.problem.space.arm_size].flatten(
        0, 1
    )
    posterior = result.posterior
    total = _square(J, posterior.root)
    groups = {"camera": "the intrinsics", "board": "the scale of the board"}
    shares = {}
    for group, what in groups.items():
        rows = [k for k, parameter in enumerate(posterior.parameters) if parameter.group == group]
        if rows:
            shares[what] = 1 - _square(J, _conditioned(posterior.root, rows)) / total
    return (total * 3) ** 0.5, shares


def _conditioned(root: Float64[Tensor, "unknowns directions"], rows: list[int]) -> Tensor:
    """Root of the covariance where some of the unknowns are known: the directions that move these are taken out."""
    axes, strength, _ = torch.linalg.svd(root[rows].t(), full_matrices=False)
    axes = axes[:, strength > 1e-9 * strength.max()]
    conditioned: Tensor = root - (root @ axes) @ axes.t()
    return conditioned


def _square(J: Tensor, root: Tensor) -> float:
    """Mean square of a coordinate's predicted error [m^2]."""
    return float((J @ root[: J.shape[1]]).square().sum(1).mean())
