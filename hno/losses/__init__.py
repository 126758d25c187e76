"""Loss terms. A recipe is a short list of them; weights live in the configuration."""

from hno.losses.base import STREAMS, LossTerm, Norm, Scales, losses, used_weights
from hno.losses.hji import hji_residual

__all__ = ["STREAMS", "LossTerm", "Norm", "Scales", "hji_residual", "losses", "used_weights"]
