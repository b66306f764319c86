"""Choice of network inputs: mutual information, MRMR ranking and Lipschitz quotients.

`mutual_information` (histogram or nearest neighbours), `rank_mrmr` (which inputs), `lag_curve` (how many lags).
Arrays are plain numpy, samples in rows; units do not matter: information is invariant to them, quotients are scaled.
"""

from testbed.features.information import mutual_information, mutual_information_knn
from testbed.features.lipschitz import LagCurve, lag_curve, lipschitz_index
from testbed.features.mrmr import Ranked, rank_mrmr

__all__ = [
    "LagCurve",
    "Ranked",
    "lag_curve",
    "lipschitz_index",
    "mutual_information",
    "mutual_information_knn",
    "rank_mrmr",
]
