"""Exported controllers without torch: NumPy is all that this needs."""

from hno.runtime.artefact import Artefact, ArtefactError, read_manifest, signed
from hno.runtime.belief import Believer, Learning
from hno.runtime.load import load

__all__ = ["Artefact", "ArtefactError", "Believer", "Learning", "load", "read_manifest", "signed"]
