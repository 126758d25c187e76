"""Labels, sources of collocation points, and the datamodule that mixes them."""

from hno.data.datamodule import GameData
from hno.data.plans import Collocation, LabelPlan
from hno.data.sources import Known, Source, make_sampler, sources

__all__ = ["Collocation", "GameData", "Known", "LabelPlan", "Source", "make_sampler", "sources"]
