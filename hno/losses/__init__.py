"""Loss terms and the objective that weighs them."""

from hno.losses.base import STREAMS, LossTerm, Scales, View, losses
from hno.losses.hji import hji_residual
from hno.losses.objective import Norm, Objective, make_objective

__all__ = ["STREAMS", "LossTerm", "Norm", "Objective", "Scales", "View", "hji_residual", "losses", "make_objective"]
