"""How like the other robots of a fleet one is, and whether the fleet says anything of it."""

from dataclasses import dataclass

import torch
from scipy.stats import chi2

from pisigma.estimation.population import ODD, Population
from pisigma.lifetime.fleet.prior import class_population, evidence_of, of_arm
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import ModelPosterior


@dataclass(frozen=True)
class Likeness:
    """How like the other robots of a fleet one is.

    Attributes:
        probability: that a robot of the fleet is as far from its mean, or farther.
        gain: log evidence of its rows as those of a robot of the fleet, minus that as those of any of its class.
    """

    probability: float
    gain: float

    @staticmethod
    def of(model: CalibratedModel, rows: Measurements) -> "Likeness":
        """See how far the robot of some rows is from the mean of a fleet prior.

        Args:
            model: of the prior.
            rows: of the robot.

        Raises:
            IdentificationError: the rows do not determine where the robot stands.
        """
        posterior = ModelPosterior.of(model)
        root = of_arm(posterior.root, posterior.space)
        drawn = posterior.space.robot
        errors = torch.from_numpy(posterior.geometry.robot.dh - drawn.dh)
        mean = torch.cat([errors.flatten(), posterior.weights])
        evidence = evidence_of(model, mean, rows)
        fleet = Population(mean, root @ root.t(), posterior.space.arm_size)
        square, count = fleet.surprise(evidence)
        gain = fleet.log_evidence(evidence) - class_population(drawn).log_evidence(evidence)
        return Likeness(float(chi2.sf(square, count)), gain)

    @property
    def odd(self) -> bool:
        """Whether the fleet says little of the robot: less than the usual errors of its class."""
        return self.probability < ODD and self.gain < 0

    @property
    def sentence(self) -> str:
        """The same in words."""
        if self.odd:
            return (
                f"This robot is unlike the fleet: fewer than 1 in {1 / ODD:,.0f} of its robots are as far from the "
                "mean, and the usual errors of its class explain its rows better. The fleet does not count where the "
                "rows are enough for a calibration of their own."
            )
        share = f"{100 * self.probability:.0f} %" if self.probability >= 0.01 else "fewer than 1 %"
        return f"This robot is like the fleet: {share} of its robots are as far from the mean, or farther."
