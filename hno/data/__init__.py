"""Labels, collocation points and the datamodule that mixes them."""

from hno.data.datamodule import GameData

__all__ = ["GameData"]
