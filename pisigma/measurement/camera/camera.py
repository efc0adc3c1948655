"""Cameras: intrinsics, projection of points, and camera files."""

import os
import re
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field, field_validator

from pisigma.files.errors import MeasurementError, Place
from pisigma.files.input_file import read_text
from pisigma.files.yaml_file import MAX_BYTES, Section, parse_yaml
from pisigma.files.yaml_writing import yaml_text
from pisigma.measurement.sensors.intrinsics import CAMERA_UNITS

INTRINSICS = tuple(CAMERA_UNITS)
USUAL_DEVIATIONS = (0.5, 0.5, 1.0, 1.0, 0.002, 0.01, 2e-4, 2e-4, 0.0)
"""Standard deviations of the intrinsics after a typical calibration, with 0 for k3, which is seldom estimated."""

Positive = Annotated[float, Field(gt=0)]
_UNDISTORTED = 1e-14
"""Newton step below which the undistorted point has converged up to rounding."""
_MAX_UNDISTORT_ITERATIONS = 20
"""Largest number of Newton iterations from a distorted to the undistorted point; ordinary lenses need four."""


class IntrinsicDeviationsSection(Section):
    """One number per intrinsic parameter of a camera, such as its standard deviation; 0 if not given.

    Attributes:
        fx: value of the focal length along u [px].
        fy: value of the focal length along v [px].
        cx: value of the principal point, u [px].
        cy: value of the principal point, v [px].
        k1: value of the first radial distortion coefficient.
        k2: value of the second radial distortion coefficient.
        p1: value of the first tangential distortion coefficient.
        p2: value of the second tangential distortion coefficient.
        k3: value of the third radial distortion coefficient.
    """

    fx: float = 0.0
    fy: float = 0.0
    cx: float = 0.0
    cy: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def numbers(self) -> tuple[float, ...]:
        """All values in the order of `INTRINSICS`."""
        return tuple(self.model_dump().values())


class CameraDocument(Section):
    """Contents of a camera file of pisigma, with OpenCV's distortion model.

    Attributes:
        name: name of the camera.
        width: width of its images [px].
        height: height of its images [px].
        fx: focal length along u [px].
        fy: focal length along v [px].
        cx: principal point, u [px].
        cy: principal point, v [px].
        k1: first radial distortion coefficient.
        k2: second radial distortion coefficient.
        p1: first tangential distortion coefficient.
        p2: second tangential distortion coefficient.
        k3: third radial distortion coefficient.
        sigma: standard deviations of the intrinsics.
        is_fixed: whether the camera is fixed and the board is on the flange; otherwise the camera is on the flange.
    """

    name: str = "camera"
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    sigma: IntrinsicDeviationsSection | None = None
    is_fixed: bool = False

    @field_validator("sigma")
    @classmethod
    def _not_negative(cls, sigma: IntrinsicDeviationsSection | None) -> IntrinsicDeviationsSection | None:
        """Refuse a standard deviation below 0."""
        for name, number in () if sigma is None else sigma:
            if number < 0:
                raise ValueError(f"expected a standard deviation >= 0 for {name}, got {number:g}")
        return sigma

    def camera(self) -> "Camera":
        """Return the camera."""
        sigma = None if self.sigma is None else self.sigma.numbers
        return Camera(**self.model_dump(exclude={"sigma"}), sigma=sigma)


class MatrixSection(BaseModel):
    """A matrix in a ROS or OpenCV file, row by row; other keys of the matrix are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)
    data: tuple[float, ...]


class RosOrOpencvCameraDocument(BaseModel):
    """Contents of a camera file of ROS (`camera_info`) or of OpenCV's calibration sample.

    Fisheye lenses are refused because their coefficients have a different meaning; binned images are refused because
    their pixels are larger.
    """

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)
    camera_name: str = "camera"
    image_width: int = Field(gt=0)
    image_height: int = Field(gt=0)
    distortion_model: Literal["plumb_bob"] = "plumb_bob"
    fisheye_model: Literal[0] = 0
    binning_x: Literal[0, 1] = 0
    binning_y: Literal[0, 1] = 0
    camera_matrix: MatrixSection
    distortion_coefficients: MatrixSection


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with radial and tangential distortion (Brown 1971, as in OpenCV and ROS's plumb_bob).

    The z axis points out of the camera, x to the right and y down in the image.

    Attributes:
        name: name of the camera.
        width: width of its images [px].
        height: height of its images [px].
        fx: focal length along u [px].
        fy: focal length along v [px].
        cx: principal point, u [px].
        cy: principal point, v [px].
        k1: first radial distortion coefficient.
        k2: second radial distortion coefficient.
        p1: first tangential distortion coefficient.
        p2: second tangential distortion coefficient.
        k3: third radial distortion coefficient.
        sigma: standard deviations of fx, fy, cx, cy [px], k1, k2, p1, p2, k3; None if not stated.
        is_fixed: whether the camera is fixed and the board is on the flange; otherwise the camera is on the flange.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    sigma: tuple[float, ...] | None = None
    is_fixed: bool = False

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Camera":
        """Read a camera from pisigma's own YAML, a ROS `camera_info` or an OpenCV file.

        Raises:
            MeasurementError: the file cannot be read or is not a valid camera; `file` and `column` state the key.
        """
        source = os.fspath(path)
        text = read_text(path, MeasurementError, "YAML", MAX_BYTES)
        if not re.search(r"^\s*camera_matrix\s*:", text, re.MULTILINE):
            return parse_yaml(text, CameraDocument, MeasurementError, source).camera()
        # OpenCV writes a directive and a tag that are not YAML; commenting them out keeps the line numbers
        plain = re.sub(r"^%YAML.*$|^---\s*$", "#", text, flags=re.MULTILINE).replace("!!opencv-matrix", "")
        document = parse_yaml(plain, RosOrOpencvCameraDocument, MeasurementError, source)
        matrix, coefficients = document.camera_matrix.data, document.distortion_coefficients.data
        if len(matrix) != 9 or matrix[0] <= 0 or matrix[4] <= 0 or any(matrix[k] for k in (1, 3, 6, 7)):
            raise MeasurementError(
                expected="a matrix fx, 0, cx, 0, fy, cy, 0, 0, 1",
                value=matrix,
                at=Place(source, column="camera_matrix.data"),
            )
        if len(coefficients) < 4 or any(coefficients[5:]):
            raise MeasurementError(
                expected="the coefficients k1, k2, p1, p2 and k3 only",
                value=coefficients,
                at=Place(source, column="distortion_coefficients.data"),
                remedy="calibrate the camera with these coefficients",
            )
        size = (document.camera_name, document.image_width, document.image_height)
        k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
        return Camera(*size, matrix[0], matrix[4], matrix[2], matrix[5], k1, k2, p1, p2, k3)

    def to_yaml(self) -> str:
        """Return the camera as the text of a file that `load` reads."""
        numbers = dict(zip(INTRINSICS, self.intrinsics.tolist(), strict=True))
        content = {"name": self.name, "width": self.width, "height": self.height, **numbers}
        if self.is_fixed:
            content["is_fixed"] = True
        sigma = {} if self.sigma is None else {"sigma": dict(zip(INTRINSICS, self.sigma, strict=True))}
        return yaml_text(content | sigma)

    @property
    def intrinsics(self) -> Float64[np.ndarray, " 9"]:
        """All intrinsics in the order of `INTRINSICS` [px; k1, k2, p1, p2, k3 without unit]."""
        return np.array([getattr(self, name) for name in INTRINSICS])

    def with_intrinsics(self, values: Float64[np.ndarray, " 9"]) -> "Camera":
        """Return the camera with other intrinsics, in the order of `INTRINSICS`."""
        return replace(self, **dict(zip(INTRINSICS, values.tolist(), strict=True)))

    def project(
        self, points: Float64[np.ndarray, "*batch 3"]
    ) -> tuple[Float64[np.ndarray, "*batch 2"], Float64[np.ndarray, "*batch 2 3"]]:
        """Return the pixels of points in the camera's frame [m], and derivatives with respect to the points [px/m]."""
        xy = points[..., :2] / points[..., 2:]
        distorted, derivative = self._distorted(xy)
        scale = np.array([self.fx, self.fy])
        point_jacobian = np.zeros((*xy.shape, 3))
        point_jacobian[..., 0, 0] = point_jacobian[..., 1, 1] = 1.0
        point_jacobian[..., 2] = -xy
        point_jacobian /= points[..., 2, None, None]
        return distorted * scale + (self.cx, self.cy), scale[:, None] * (derivative @ point_jacobian)

    def intrinsics_jacobian(
        self, points: Float64[np.ndarray, "*batch 3"]
    ) -> Float64[np.ndarray, "*batch 2 9"]:
        """Return the derivative of the pixels of points in the camera's frame [m] with respect to the intrinsics.

        Pixels are focal lengths times a polynomial that is linear in the distortion, so the derivatives are the
        factors themselves.
        """
        xy = points[..., :2] / points[..., 2:]
        x, y = xy[..., 0], xy[..., 1]
        square = x * x + y * y
        derivative = np.zeros((*xy.shape, len(INTRINSICS)))
        distorted = self._distorted(xy)[0]
        for axis, focal in enumerate((self.fx, self.fy)):
            derivative[..., axis, axis] = distorted[..., axis]
            derivative[..., axis, 2 + axis] = 1.0
            for column, power in ((4, square), (5, square**2), (8, square**3)):
                derivative[..., axis, column] = focal * xy[..., axis] * power
        derivative[..., 0, 6], derivative[..., 0, 7] = self.fx * 2 * x * y, self.fx * (square + 2 * x * x)
        derivative[..., 1, 6], derivative[..., 1, 7] = self.fy * (square + 2 * y * y), self.fy * 2 * x * y
        return derivative

    def undistort(self, pixels: Float64[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return x / z and y / z of the rays of pixels, by Newton's method."""
        distorted = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        xy = distorted.copy()
        for _ in range(_MAX_UNDISTORT_ITERATIONS):
            now, derivative = self._distorted(xy)
            step = np.linalg.solve(derivative, (distorted - now)[..., None])[..., 0]
            xy += step
            if not np.abs(step).max(initial=0.0) > _UNDISTORTED:
                break
        return xy

    def _distorted(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distorted x / z and y / z, and their derivatives with respect to the undistorted values."""
        x, y = xy[..., 0], xy[..., 1]
        square = x * x + y * y
        radial = 1 + square * (self.k1 + square * (self.k2 + square * self.k3))
        slope = self.k1 + square * (2 * self.k2 + 3 * self.k3 * square)
        distorted = xy * radial[..., None]
        distorted[..., 0] += 2 * self.p1 * x * y + self.p2 * (square + 2 * x * x)
        distorted[..., 1] += self.p1 * (square + 2 * y * y) + 2 * self.p2 * x * y
        derivative = np.empty((*xy.shape, 2))
        derivative[..., 0, 0] = radial + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        derivative[..., 1, 1] = radial + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
        mixed = 2 * (x * y * slope + self.p1 * x + self.p2 * y)
        derivative[..., 0, 1] = derivative[..., 1, 0] = mixed
        return distorted, derivative
