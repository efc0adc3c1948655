"""Check for known weaknesses of camera calibrations: views, intrinsics, tool, and limits of the accuracy."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.shared_objects import uncertainty_of
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.measurement.conditions import JointState
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
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

_FRONTAL = np.deg2rad(12.0)
"""Angle of views [rad]; if 90 % of the views are less oblique, the error over the workspace is 1.5 to 3 times that
of typical views."""
_ONE_BRANCH = 0.95
"""Share of the images in one branch of the arm above which the other branches are treated as unmeasured."""
_EXPLAINED = 1.3
"""Ratio of the images' scatter to the scatter explained by their corners, below which no model of the arm can
improve the fit."""
_WIDE = 3.0
"""Standard deviation of the focal length [px] above which intrinsics are regarded as free; 0.5 is typical."""
_CONTRADICTED = 4.0
"""Deviation, in standard deviations, above which estimated intrinsics contradict their calibration."""
_POSTURES = 200
"""Number of random joint vectors at which the error over the joint space is predicted."""


def check_camera(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Report known weaknesses of a camera calibration; `benchmarks/camera.py` measures their effects."""
    by_corners = checked.rows.is_measured("corner")
    if not bool(by_corners.any()):
        return
    images, result = checked.rows.select(by_corners), checked.geometric
    yield from view_warnings(images.T[:, 2, 2].abs().clamp(max=1.0).acos().cpu(), images.q, checked.robot)
    yield from _intrinsics(images, result)
    yield from _tool(images, checked.rows, result)
    if bool(by_corners.all()):  # with other sensors, the camera need not limit the accuracy
        yield from _limit(images, result)


def _warning(cause: str, sentence: str, **values: float | str) -> Diagnostic:
    return Diagnostic(kind="camera", severity="warning", sentence=sentence, cause=cause, values=values)


def view_warnings(
    tilt: Float64[Tensor, " images"], q: Float64[Tensor, "images dof"], robot: Robot
) -> Iterator[Diagnostic]:
    """Return warnings about views of a board that are too frontal, or all in one branch of the arm.

    Args:
        tilt: angle between the optical axis and the normal of the board [rad].
        q: joint values [rad or m].
        robot: the nominal robot.
    """
    most = float(tilt.quantile(0.9))
    if most < _FRONTAL:
        yield _warning(
            "frontal_views",
            f"In 90 % of the images the board is tilted by less than {np.rad2deg(most):.0f} deg relative to the camera."
            " Such views hardly determine the distance and the tilt of the camera, and lead to 1.5 to 3 times the "
            "error; take images with tilts of up to 40 deg.",
            tilt_deg=float(np.rad2deg(most)),
        )
    solver = closed_form_solver(robot)
    share = 0.0 if solver is None else _largest_share(nearest_branch(solver, q))
    if share >= _ONE_BRANCH:
        yield _warning(
            "one_branch",
            f"{100 * share:.0f} % of the images were taken in one branch of the arm (the same configuration of "
            "shoulder, elbow and wrist); the errors look small in this branch and are up to three times as large "
            "in other configurations; take images in other branches.",
            share=share,
        )


def _largest_share(branch: Tensor) -> float:
    return float(torch.bincount(branch).max()) / len(branch)


def _intrinsics(images: Measurements, result: CalibrationResult) -> Iterator[Diagnostic]:
    """Warn about intrinsics that are fixed, free, or far from their calibration."""
    identified = ImageIntrinsics.from_csv_cells(texts_of(images, INTRINSICS_COLUMN))
    cells = zip(texts_of(images, CAMERA_COLUMN), identified.prior_mean, identified.prior_sigma, strict=True)
    first = {camera: (stated, sigma) for camera, stated, sigma in reversed(list(cells)) if camera}
    for camera, (stated, sigma) in sorted(first.items()):
        if not sigma.any():
            yield _warning(
                "intrinsics_fixed",
                f"The intrinsics of camera '{camera}' were fixed at the values of its file; if these have the "
                "errors of a typical calibration, the error over the workspace can double. "
                "Estimate them under their prior, or check them.",
                camera=camera,
            )
            continue
        free = sigma > 0
        off = (result.sensor_unknowns["camera"][camera] - stated)[free] / sigma[free]
        if sigma[0] > _WIDE:
            yield _warning(
                "intrinsics_free",
                f"The intrinsics of camera '{camera}' were estimated without a prior, so a bow of the board "
                "appears as distortion (a bow of 0.3 mm changes k1 and the distance); give a calibration of the "
                "camera if you have one, and mount the board on glass.",
                camera=camera,
            )
        elif np.abs(off).max() > _CONTRADICTED:
            yield _warning(
                "intrinsics_contradicted",
                f"The images contradict the calibration of camera '{camera}' by {np.abs(off).max():.1f} standard "
                "deviations; check that the calibration belongs to this lens, focus and resolution, and that the board "
                "is flat.",
                camera=camera,
                deviations=float(np.abs(off).max()),
            )


def _tool(images: Measurements, rows: Measurements, result: CalibrationResult) -> Iterator[Diagnostic]:
    """Warn that the hand-eye transform cannot be separated from the last DH row if only images were measured."""
    last = [name for name in result.redundancy.removed if name.endswith(f"_{len(result.robot.joints)}")]
    if last and images.rows == rows.rows:
        yield _warning(
            "tool_not_identified",
            f"The pose of the camera (or the board) on the flange cannot be distinguished from errors of the last "
            f"joint's row ({', '.join(last)}), so a tool that is defined in the flange frame is not identified; "
            "measure a few positions of that tool with another sensor, or teach its TCP.",
        )


def _limit(images: Measurements, result: CalibrationResult) -> Iterator[Diagnostic]:
    """Warn that the images limit the accuracy, with the shares of the predicted error due to intrinsics and boards."""
    problem, view = result.solved.problem, contributions_and_noise_of(result.solved.refined_linearisation)
    number = next(k for k, sensor in enumerate(problem.sensors) if sensor.name == "corner")
    ratio = view.noise[number] / float(torch.as_tensor(images.readings[NOISE_COLUMN]).median())
    if ratio >= _EXPLAINED:
        return
    total, shares = _predicted_error(result)
    parts = [
        f"{100 * share:.0f} % of its square from {what}" for what, share in shares.items() if share >= 0.1
    ]
    yield _warning(
        "camera_limits",
        f"The camera limits this calibration: the scatter of its images is {ratio:.2f} times what the noise of the "
        "corners and the repeatability explain, and the predicted standard deviation of a position is "
        f"{total * 1e3:.2g} mm RMS over the joint space{', ' + ' and '.join(parts) if parts else ''}. More images, "
        "a larger or closer board, or more pixels would reduce the error.",
        scatter=float(ratio),
        predicted_mm=total * 1e3,
        **{f"share_{what.split()[-1]}": share for what, share in shares.items()},
    )


def _predicted_error(result: CalibrationResult) -> tuple[float, dict[str, float]]:
    """Predict the RMS error of a target's position over the joint space [m], and the shares of its square.

    The position is that of the first target in the first frame.
    """
    limits = torch.from_numpy(np.asarray(result.robot.limits)).clamp(-np.pi, np.pi)
    generator = torch.Generator().manual_seed(0)
    draws = torch.rand(_POSTURES, len(limits), generator=generator, dtype=torch.float64)
    q = limits[:, 0] + draws * (limits[:, 1] - limits[:, 0])
    J = uncertainty_of(result).pose_derivatives(JointState(q), q)[:, :3].flatten(0, 1)
    posterior = result.posterior
    total = _square(J, posterior.covariance_root)
    groups = {"camera": "the intrinsics", "board": "the scale of the board"}
    shares = {}
    for group, what in groups.items():
        rows = [k for k, parameter in enumerate(posterior.parameters) if parameter.group == group]
        if rows:
            shares[what] = 1 - _square(J, _conditioned(posterior.covariance_root, rows)) / total
    return (total * 3) ** 0.5, shares


def _conditioned(root: Float64[Tensor, "unknowns directions"], rows: list[int]) -> Tensor:
    """Return the covariance root conditional on given unknowns, by removing the directions that move them."""
    axes, strength, _ = torch.linalg.svd(root[rows].t(), full_matrices=False)
    axes = axes[:, strength > 1e-9 * strength.max()]
    conditioned: Tensor = root - (root @ axes) @ axes.t()
    return conditioned


def _square(J: Tensor, root: Tensor) -> float:
    """Compute the mean square of a coordinate's predicted error [m²]."""
    return float((J @ root).square().sum(1).mean())
