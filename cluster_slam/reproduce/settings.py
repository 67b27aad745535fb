"""What a reproduction may vary, and what the paper printed."""

from __future__ import annotations

from dataclasses import dataclass

from cluster_slam.errors import ConfigError
from tracking.errors import ParameterError
from tracking.unscented import SigmaRule

SEED = 1  # of every MATLAB stream; found by search, confirmed by the outlier rates that the search did not use
N_SAMPLES = 10_000
PROBABILITY = 0.95
PADDING_M = 0.005


@dataclass(frozen=True, slots=True)
class Settings:
    """Parameters of the unscented transform, the noise and the size of the simulated clusters."""

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0
    noise: float = 0.01  # m, the lowest of five levels of table I and the noise of table II
    scale: float = 1.0  # m, side of the cube that flowers are drawn in

    def __post_init__(self) -> None:
        for name in ("noise", "scale"):
            value = getattr(self, name)
            if not 0 < value < float("inf"):
                raise ConfigError(f"{name} must be a length > 0, got {value}")
        try:
            rule = self.rule
            rule.spread_sq(9)
        except ParameterError as error:
            raise ConfigError(str(error)) from None

    @property
    def rule(self) -> SigmaRule:
        """The sigma points."""
        return SigmaRule(self.alpha, self.beta, self.kappa)

    @property
    def noise_levels(self) -> tuple[float, ...]:
        """One to five times the noise, m."""
        return tuple(self.noise * k for k in (1, 2, 3, 4, 5))

    @property
    def is_paper(self) -> bool:
        """Whether all is as in the paper, so that its numbers are comparable."""
        return self == Settings()


PAPER_TABLE_1 = ((1.2314e-6, 5.01), (4.1397e-6, 4.93), (4.1437e-5, 4.83), (1.5409e-4, 4.75), (4.0231e-4, 4.65))
PAPER_TABLE_2 = ((8820, 736.1542), (9420, 797.0514))  # correct matches, false ones on average; without, with padding
PAPER_TABLE_3 = (
    ("Data1-Data1", 4950, 4954),
    ("Data2-Data1", 13, 277),
    ("Data3-Data3", 1195, 2437),
    ("Data4-Data3", 30, 1005),
)
