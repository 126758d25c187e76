"""Parametric value functions of general-sum differential games, and the feedback controllers they give.

Names are imported when they are first used, so that `import hno` takes no time.
"""

from __future__ import annotations

import pkgutil
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hno import games
    from hno.cli.calls import certify, evaluate, train
    from hno.control.belief import Believing
    from hno.control.exported import load_exported
    from hno.control.rollout import rollout
    from hno.games.testing import check_game
    from hno.pontryagin.solve import solve
    from hno.training.checkpoint import load_policy
    from hno.training.fit import fit

__version__ = "0.1.0"
__all__ = [
    "Believing",
    "__version__",
    "certify",
    "check_game",
    "evaluate",
    "fit",
    "games",
    "load_exported",
    "load_policy",
    "rollout",
    "solve",
    "train",
]

_PLACES = {
    "Believing": "hno.control.belief:Believing",
    "certify": "hno.cli.calls:certify",
    "check_game": "hno.games.testing:check_game",
    "evaluate": "hno.cli.calls:evaluate",
    "fit": "hno.training.fit:fit",
    "games": "hno.games",
    "load_exported": "hno.control.exported:load_exported",
    "load_policy": "hno.training.checkpoint:load_policy",
    "rollout": "hno.control.rollout:rollout",
    "solve": "hno.pontryagin.solve:solve",
    "train": "hno.cli.calls:train",
}


def __getattr__(name: str) -> Any:
    """A public name, imported now."""
    if name not in _PLACES:
        raise AttributeError(f"module 'hno' has no attribute {name!r}; it offers {', '.join(__all__)}")
    found = globals()[name] = pkgutil.resolve_name(_PLACES[name])
    return found


def __dir__() -> list[str]:
    return __all__
