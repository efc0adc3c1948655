"""Feature for errors of gears and encoders: sines and cosines of multiples of a joint's value."""

from typing import Annotated, Any, Literal, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, Shaped
from pydantic import Field
from torch import Tensor

from pisigma.joint_correction.feature import (
    AbstractFeature,
    FeatureOptions,
    FeatureSection,
    angle_per_joint_value,
)
from pisigma.joint_correction.onnx_graph import OnnxGraph
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot
from pisigma.robot.kernels.forms import MAX_JOINTS, CompiledForm

BAND_STARTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
"""First harmonic of every band for few configurations: about two bands per octave."""
FINE_BAND_STARTS = (*range(1, 10), 11, 13, 15, 18, 21, 25, 30, 35, 41, 49, 58, 69, 82, 97, 115, 137, 163)
"""First harmonic of every band for many configurations: one harmonic per band up to 8, then about four bands per
octave. In all 29 subsets of the measured UR5 and UR10 that were tested (random folds, boxes and halves), the log
evidence is higher than with `BAND_STARTS`, by 12 on average for 11 additional prior scales. Eight bands per octave
raise it by another 17 for 18 scales, which is less than one per scale (Akaike 1974, IEEE Transactions on Automatic
Control 19(6))."""
MANY_CONFIGURATIONS = 200
"""Smallest number of configurations with which fine bands are used; fewer do not determine the size of every band."""
BAND_SIZES = (
    2e-4,
    1.6e-4,
    3e-5,
    3e-5,
    8e-5,
    5e-5,
    5e-5,
    4e-5,
    3e-5,
    6e-6,
    4e-6,
    3e-6,
    3e-6,
    3e-6,
    3e-6,
    3e-6,
)
"""Initial standard deviations of the weights of every band of `BAND_STARTS` [rad] for fits of few rows.

They lie between the sizes that maximise the evidence of hybrid calibrations of the measured UR5, UR10 and FANUC
R-2000iC and those of simulated arms with gear errors of 0.26 mrad at harmonics 1, 2 and 7."""
USUAL_HARMONICS = 56
"""Number of harmonics up to which series are tried for any number of rows, because fits of few rows start with
`BAND_SIZES`."""


class SeriesSection(FeatureSection):
    """Section of a Fourier series in the description of a model."""

    name: Literal["series"]
    harmonics: Annotated[int, Field(ge=1, le=100_000)]
    fine: bool = False


@no_type_check
def add_series(arms: Any, correction: Any, first_value_index: int, memory: Any, q: Any) -> None:
    """Add sums of sines and cosines of multiples of every joint's angle, four joints at a time.

    `correction.values` contains the number of harmonics, and for each the weights of the sines and of the cosines of
    `MAX_JOINTS` joints.

    Source: C. W. Clenshaw, A note on the summation of Chebyshev series, 1955: from the last multiple to the first,
    `b_k = w_k + 2 cos(θ) b_k+1 - b_k+2`; the sum is `b_1 cos(θ) - b_2` of cosines and `b_1 sin(θ)` of sines.
    """
    values = correction.values
    harmonics = int(values[first_value_index])
    for j in range(0, arms.dof, 4):
        sine, cosine = memory.turning[0, j : j + 4], memory.turning[1, j : j + 4]
        total = memory.delta[j : j + 4]
        t_0, t_1, t_2, t_3 = 2 * cosine[0], 2 * cosine[1], 2 * cosine[2], 2 * cosine[3]
        s_0, s_1, s_2, s_3, c_0, c_1, c_2, c_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        u_0, u_1, u_2, u_3, v_0, v_1, v_2, v_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(harmonics - 1, -1, -1):
            start = first_value_index + 1 + 2 * MAX_JOINTS * k + j
            a, b = values[start : start + 4], values[start + MAX_JOINTS : start + MAX_JOINTS + 4]
            # s and c are b_k+1 of the sines and of the cosines, u and v are b_k+2.
            u_0, s_0 = s_0, t_0 * s_0 + (a[0] - u_0)
            u_1, s_1 = s_1, t_1 * s_1 + (a[1] - u_1)
            u_2, s_2 = s_2, t_2 * s_2 + (a[2] - u_2)
            u_3, s_3 = s_3, t_3 * s_3 + (a[3] - u_3)
            v_0, c_0 = c_0, t_0 * c_0 + (b[0] - v_0)
            v_1, c_1 = c_1, t_1 * c_1 + (b[1] - v_1)
            v_2, c_2 = c_2, t_2 * c_2 + (b[2] - v_2)
            v_3, c_3 = c_3, t_3 * c_3 + (b[3] - v_3)
        total[0] += sine[0] * s_0 + (cosine[0] * c_0 - v_0)
        total[1] += sine[1] * s_1 + (cosine[1] * c_1 - v_1)
        total[2] += sine[2] * s_2 + (cosine[2] * c_2 - v_2)
        total[3] += sine[3] * s_3 + (cosine[3] * c_3 - v_3)


@no_type_check
def add_series_slope(arms: Any, correction: Any, first_value_index: int, memory: Any, q: Any) -> None:
    """Add the derivative of every joint's series with respect to its joint value, with the same recurrence."""
    values = correction.values
    harmonics = int(values[first_value_index])
    for j in range(0, arms.dof, 4):
        sine, cosine = memory.turning[0, j : j + 4], memory.turning[1, j : j + 4]
        total, rate = memory.slope[j : j + 4], correction.rate[j : j + 4]
        t_0, t_1, t_2, t_3 = 2 * cosine[0], 2 * cosine[1], 2 * cosine[2], 2 * cosine[3]
        s_0, s_1, s_2, s_3, c_0, c_1, c_2, c_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        u_0, u_1, u_2, u_3, v_0, v_1, v_2, v_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(harmonics - 1, -1, -1):
            start, times = first_value_index + 1 + 2 * MAX_JOINTS * k + j, k + 1.0
            a, b = values[start : start + 4], values[start + MAX_JOINTS : start + MAX_JOINTS + 4]
            # The derivative of a sin(k θ) + b cos(k θ) is k a cos(k θ) - k b sin(k θ).
            u_0, s_0 = s_0, t_0 * s_0 - (times * b[0] + u_0)
            u_1, s_1 = s_1, t_1 * s_1 - (times * b[1] + u_1)
            u_2, s_2 = s_2, t_2 * s_2 - (times * b[2] + u_2)
            u_3, s_3 = s_3, t_3 * s_3 - (times * b[3] + u_3)
            v_0, c_0 = c_0, t_0 * c_0 + (times * a[0] - v_0)
            v_1, c_1 = c_1, t_1 * c_1 + (times * a[1] - v_1)
            v_2, c_2 = c_2, t_2 * c_2 + (times * a[2] - v_2)
            v_3, c_3 = c_3, t_3 * c_3 + (times * a[3] - v_3)
        total[0] += rate[0] * (sine[0] * s_0 + (cosine[0] * c_0 - v_0))
        total[1] += rate[1] * (sine[1] * s_1 + (cosine[1] * c_1 - v_1))
        total[2] += rate[2] * (sine[2] * s_2 + (cosine[2] * c_2 - v_2))
        total[3] += rate[3] * (sine[3] * s_3 + (cosine[3] * c_3 - v_3))


class FourierSeries(AbstractFeature):
    """Columns sin(k q_j) and cos(k q_j) of the value q_j of a joint for k = 1 … K.

    Weights of neighbouring harmonics share a prior scale (see `BAND_STARTS`), so that the data determine how the
    spectrum of the error decreases with k; fine bands (see `FINE_BAND_STARTS`) contain fewer harmonics. Source of the
    model: Judd and Knasinski, IEEE Transactions on Robotics and Automation 6(1), 1990, 20-30.
    """

    name = "series"
    section = SeriesSection
    compiled = CompiledForm(add_series, add_series_slope)

    def __init__(self, robot: Robot, harmonics: int, fine: bool = False) -> None:
        """Create the feature with the first `harmonics` harmonics, at least one, in coarse or fine bands."""
        super().__init__(robot)
        if harmonics < 1:
            raise ValueError(f"expected at least one harmonic of a Fourier series, got {harmonics}.")
        self.harmonics = self.size = self.highest_harmonic = harmonics
        self.fine = fine
        self._rate = torch.from_numpy(angle_per_joint_value(robot))
        k = torch.arange(1, harmonics + 1)
        starts = FINE_BAND_STARTS if fine else BAND_STARTS
        band = torch.bucketize(k, torch.tensor(starts), right=True) - 1
        self.used = torch.ones(robot.dof, 2 * harmonics, dtype=torch.bool)
        self.group = torch.cat([band, band]).expand(robot.dof, -1)
        ends = [*(start - 1 for start in starts[1:]), harmonics]
        self.group_names = tuple(
            f"harmonics {starts[b]} to {min(ends[b], harmonics)}" for b in range(int(band.max()) + 1)
        )
        self._starts = torch.tensor(starts[: len(self.group_names)])

    @property
    def usual_sizes(self) -> tuple[float, ...]:
        """Initial standard deviation of the weights of every band [rad]."""
        bands = torch.bucketize(self._starts, torch.tensor(BAND_STARTS), right=True) - 1
        return tuple(BAND_SIZES[band] for band in bands.tolist())

    @classmethod
    def candidates(
        cls, robot: Robot, options: FeatureOptions, state: JointState
    ) -> tuple["FourierSeries", ...]:
        """Return series of increasing size; above `USUAL_HARMONICS`, up to twice the number of configurations."""
        most = max(2 * options.configuration_count, min(options.harmonics), USUAL_HARMONICS)
        fine = options.configuration_count >= MANY_CONFIGURATIONS
        return tuple(FourierSeries(robot, k, fine) for k in options.harmonics if k <= most)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return the columns: all sines, beginning with sin(q), then all cosines."""
        return sines_cosines(state.q * self._rate.to(state.q), torch.arange(1, self.harmonics + 1))

    def columns_in(self, larger: AbstractFeature) -> Int64[Tensor, "dof columns"]:
        """Return the indices of this feature's sines and cosines in a longer series."""
        k = torch.arange(self.harmonics)
        return torch.cat([k, larger.size + k]).expand(self.used.shape)

    def pack(self, weight: Float64[np.ndarray, "dof columns"]) -> Float64[np.ndarray, " values"]:
        """Return the number of harmonics, and for each the weights of the sines and of the cosines of all joints."""
        lanes = np.zeros((self.harmonics, 2, MAX_JOINTS))
        lanes[..., : len(weight)] = weight.reshape(-1, 2, self.harmonics).transpose(2, 1, 0)
        return np.concatenate([[self.harmonics], lanes.ravel()])

    def add_onnx(self, graph: OnnxGraph, weight: Float64[np.ndarray, "dof columns"], q: str) -> str:
        """See `AbstractFeature.add_onnx`."""
        orders = np.arange(1.0, self.harmonics + 1)
        return add_harmonics(graph, graph.add_node("Mul", q, self._rate.numpy()), orders, weight)


def sines_cosines(
    angle: Float[Tensor, "*batch dof"], orders: Shaped[Tensor, "*dof harmonics"]
) -> Float[Tensor, "*batch dof columns"]:
    """Compute sines and then cosines of multiples of every joint's angle.

    Args:
        angle: angles of the joints [rad].
        orders: multiples of the angle, for every joint or common to all joints.
    """
    multiple = angle[..., None] * orders.to(angle)
    return torch.cat([multiple.sin(), multiple.cos()], -1)


def add_harmonics(
    graph: OnnxGraph,
    angle: str,
    orders: Float64[np.ndarray, "*dof harmonics"],
    weight: Float64[np.ndarray, "dof columns"],
) -> str:
    """Add the weighted sum of `sines_cosines` to an ONNX graph.

    Args:
        graph: graph to extend.
        angle: name of the angles `(batch, dof)` in the graph.
        orders: see `sines_cosines`.
        weight: weights of the columns.

    Returns:
        Name of the sums `(batch, dof)` in the graph.
    """
    multiple = graph.add_node("Mul", graph.reshape(angle, [len(weight), 1]), orders)
    sines, cosines = np.split(weight, 2, axis=1)
    sine = graph.add_sum(graph.add_node("Mul", graph.add_node("Sin", multiple), sines), 2)
    cosine = graph.add_sum(graph.add_node("Mul", graph.add_node("Cos", multiple), cosines), 2)
    return graph.add_node("Add", sine, cosine)
