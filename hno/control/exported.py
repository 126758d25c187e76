"""An exported controller as a policy, so that what is tested is what is deployed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor

from hno.control.policy import Feedback
from hno.games import Game, make
from hno.operators.base import ValueOperator, at_fixed_points
from hno.registry import UnknownNameError
from hno.runtime import Artefact, ArtefactError, load
from hno.runtime.artefact import MANIFEST
from hno.types import Field, Points, PotentialField, Types


class ExportedOperator(ValueOperator):
    """The field that an exported controller answers, in single precision and without derivatives of its own.

    Args:
        game: its game.
        artefact: the controller.
    """

    def __init__(self, game: Game, artefact: Artefact) -> None:
        super().__init__(game)
        self.artefact = artefact

    def answers(self, points: Points) -> dict[str, Tensor]:
        """Everything that the controller says."""
        tau, x, theta = (part.detach().cpu().numpy() for part in points)
        found = self.artefact.answers(tau, x, theta)
        return {name: torch.from_numpy(part).to(points.x.device) for name, part in found.items()}

    def field(self, points: Points, types: Types | None = None) -> Field | PotentialField:
        """What the controller says of values and derivatives, of the best branch of a potential."""
        answers = self.answers(points)
        if self.potential:
            return at_fixed_points(PotentialField(*(answers[name] for name in PotentialField._fields)), points)
        return at_fixed_points(Field(*(answers[name] for name in Field._fields)), points)

    def value(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """V_i, (B, P); it is not differentiable."""
        return self.answers(Points(tau, x, theta))["players" if self.potential else "value"]

    def value_and_costate(self, tau: Tensor, x: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Values (P,) and costates (Q, P, n) of one state; they are not differentiable."""
        answers = self.answers(Points(tau.unsqueeze(0), x.unsqueeze(0), theta.unsqueeze(0)))
        return answers["players" if self.potential else "value"][0], answers["costate"][0]


@final
class ExportedPotential(ExportedOperator):
    """The same of a controller that has a potential."""

    potential = True


@final
class ExportedPolicy(Feedback):
    """The controls of an exported controller.

    Args:
        operator: what it says.
    """

    def __init__(self, operator: ExportedOperator) -> None:
        super().__init__(operator)
        self.answers, self.about = operator.answers, operator.artefact.about

    def _controls(self, at: Points) -> Tensor:
        return self.answers(at)["control"]

    @property
    def types(self) -> list[tuple[float, ...]]:
        """Player types that it was trained with."""
        return [tuple(theta) for theta in self.origin().get("types", [])]

    def names(self) -> dict[str, str]:
        """Names of game, method, function and activation."""
        return {"game": self.about["game"], **self.origin().get("names", {})}

    def origin(self) -> dict[str, Any]:
        """Where the operator comes from, as the manifest says."""
        return dict(self.about["origin"])


def is_exported(path: str | Path) -> bool:
    """Whether there is an exported controller."""
    return (Path(path) / MANIFEST).is_file()


def load_exported(path: str | Path, game: Game | None = None) -> ExportedPolicy:
    """The policy of an exported controller; one in C is compiled first, which takes seconds.

    It is a program that runs with your rights: load what you or somebody whom you trust has exported.

    Args:
        path: the folder.
        game: its game, if that is not registered.

    Raises:
        ArtefactError: it is damaged, of another version or another game, or cannot run here.
        UnknownNameError: its game is not registered here.
    """
    artefact = load(path)
    about = artefact.about
    played = game or _made(path, about)
    if played.fingerprint() != about["fingerprint"]:
        raise ArtefactError(f"{path} is of another game, or of another version of {about['game']!r}: export it again.")
    kind = ExportedPotential if about["potential"] else ExportedOperator
    return ExportedPolicy(kind(played, artefact))


def _made(path: str | Path, about: Mapping[str, Any]) -> Game:
    try:
        return make(about["game"], **about["constants"])
    except UnknownNameError:
        raise
    except (TypeError, ValueError) as error:
        raise ArtefactError(f"{path} does not describe a game: {error}") from error
