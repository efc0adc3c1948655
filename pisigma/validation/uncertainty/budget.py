"""Uncertainty budget according to the GUM: standard uncertainties of components, and their expanded sum."""

import math
from dataclasses import dataclass
from typing import Any, Literal

COVERAGE = 0.95
"""Coverage probability of the expanded uncertainty."""


@dataclass(frozen=True)
class Component:
    """A source of uncertainty.

    Attributes:
        name: the uncertain quantity.
        evaluation: "A": from repeated observations (JCGM 100:2008, 4.2); "B": from other knowledge (4.3).
        standard_uncertainty: standard uncertainty of one coordinate of the tool's position [m].
        degrees_of_freedom: degrees of freedom; infinite if the uncertainty is assumed to be exact; None if unknown,
            which is treated as infinite.
        source: source of the figure.
    """

    name: str
    evaluation: Literal["A", "B"]
    standard_uncertainty: float
    degrees_of_freedom: float | None
    source: str

    def to_json(self) -> dict[str, Any]:
        """Return plain values with lengths in mm; infinite degrees of freedom are the text "infinite"."""
        freedom = self.degrees_of_freedom
        return {
            "name": self.name,
            "type": self.evaluation,
            "standard_uncertainty_mm": self.standard_uncertainty * 1e3,
            "degrees_of_freedom": "infinite" if freedom == math.inf else freedom,
            "source": self.source,
        }


@dataclass(frozen=True)
class UncertaintyBudget:
    """Budget of the deviation of one coordinate of the tool's position from the commanded value.

    The deviation is the sum of independent components with the sensitivity coefficient 1.

    Attributes:
        components: components whose figures come from data or from a stated setting.
        missing_components: components that are not stated and do not contribute, one sentence each.
    """

    components: tuple[Component, ...]
    missing_components: tuple[str, ...] = ()

    @property
    def combined_uncertainty(self) -> float:
        """Combined standard uncertainty [m]: `u_c² = Σ u_i²` (JCGM 100:2008, 5.1.2)."""
        return math.sqrt(sum(one.standard_uncertainty**2 for one in self.components))

    @property
    def effective_degrees_of_freedom(self) -> float:
        """Effective degrees of freedom, `u_c⁴ / Σ (u_i⁴ / ν_i)` (Welch-Satterthwaite; JCGM 100:2008, G.4.1)."""
        finite = [(one.standard_uncertainty, one.degrees_of_freedom) for one in self.components]
        spread = sum(u**4 / freedom for u, freedom in finite if freedom is not None)
        return self.combined_uncertainty**4 / spread if spread > 0 else math.inf

    @property
    def coverage_factor(self) -> float:
        """Coverage factor: the quantile of the t distribution for `COVERAGE` (JCGM 100:2008, G.3 and G.4)."""
        from scipy import stats

        return float(stats.t.ppf((1 + COVERAGE) / 2, self.effective_degrees_of_freedom))

    @property
    def expanded_uncertainty(self) -> float:
        """Expanded uncertainty of a coordinate [m]: `U = k u_c` (JCGM 100:2008, 6.2.1)."""
        return self.coverage_factor * self.combined_uncertainty

    @property
    def coverage_radius(self) -> float:
        """Radius about the commanded position that contains the tool with the probability `COVERAGE` [m].

        It is `u_c √(3 F)` with the quantile F of the F distribution with 3 and the effective degrees of freedom, for
        three coordinates with independent normal errors of the same size; with infinitely many degrees of freedom it is
        `2.80 u_c`, because the 95 % quantile of `χ²` with 3 degrees of freedom is 7.81.
        """
        from scipy import stats

        freedom = self.effective_degrees_of_freedom
        if math.isinf(freedom):
            return self.combined_uncertainty * math.sqrt(float(stats.chi2.ppf(COVERAGE, 3)))
        return self.combined_uncertainty * math.sqrt(3 * float(stats.f.ppf(COVERAGE, 3, freedom)))

    def to_json(self) -> dict[str, Any]:
        """Return plain values with lengths in mm; without components there are no combined figures."""
        plain: dict[str, Any] = {
            "components": [one.to_json() for one in self.components],
            "not_stated": list(self.missing_components),
        }
        if not self.components:
            return plain
        freedom = self.effective_degrees_of_freedom
        return plain | {
            "combined_mm": self.combined_uncertainty * 1e3,
            "effective_degrees_of_freedom": "infinite" if math.isinf(freedom) else freedom,
            "coverage": COVERAGE,
            "coverage_factor": self.coverage_factor,
            "expanded_mm": self.expanded_uncertainty * 1e3,
            "radius_mm": self.coverage_radius * 1e3,
        }
