"""Labels, sources of collocation points, and the datamodule that mixes them."""

from hno.data.datamodule import Collocation, GameData, LabelPlan
from hno.data.sources import Known, Source, make_sampler, sources

__all__ = ["Collocation", "GameData", "Known", "LabelPlan", "Source", "make_sampler", "sources"]
