"""Controllers outside of Python and torch: one graph of an operator and its game, written in several languages."""

from hno.export.lowering import UnsupportedError
from hno.export.write import KINDS, ExportError, export

__all__ = ["KINDS", "ExportError", "UnsupportedError", "export"]
