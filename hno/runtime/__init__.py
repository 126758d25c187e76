"""Exported controllers without torch: NumPy is all that this needs."""

from hno.runtime.artefact import Artefact, ArtefactError, read_manifest, signed
from hno.runtime.load import load

__all__ = ["Artefact", "ArtefactError", "load", "read_manifest", "signed"]
