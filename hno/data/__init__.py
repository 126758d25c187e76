"""Labels, sources of collocation points, and the datamodule that mixes them."""

from hno.data.datamodule import Collocation, GameData, LabelPlan
from hno.data.sources import make_sampler, sources

__all__ = ["Collocation", "GameData", "LabelPlan", "make_sampler", "sources"]
