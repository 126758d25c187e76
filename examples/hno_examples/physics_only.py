"""A run on physics alone: no label is solved; the Hamilton-Jacobi-Isaacs equation is all that is trained on.

python -m hno_examples.physics_only
"""

from __future__ import annotations

from pathlib import Path

from hno.data import Collocation, GameData, make_sampler
from hno.data.curriculum import Curriculum
from hno.games import Game
from hno.losses import make_objective
from hno.operators import ValueOperator, make_operator
from hno.training import Fitted, Settings, fit
from hno_examples.tracking import Tracking


def train(game: Game, folder: Path, steps: int = 2000, rows: int = 512) -> tuple[ValueOperator, Fitted]:
    """An operator that solves the equation, and what came of its training.

    The operator meets V(0, x) = -g(x) by construction, so the only term is the residual inside the time window, which
    widens from the end of the game backwards in the first half of the run.

    Args:
        game: the game.
        folder: where checkpoints go.
        steps: training steps.
        rows: collocation points of each step.
    """
    operator = make_operator(game)
    objective = make_objective({"residual": {}}, {"residual": 1.0})
    sampler = make_sampler({"box": 0.5, "band": 0.5})
    points = Collocation(sampler, Curriculum(start=0, length=steps // 2), types="box")
    data = GameData(game, {"interior"}, collocation=points, batch_sizes={"interior": rows})
    return operator, fit(operator, objective, data, Settings(steps=steps), folder)


if __name__ == "__main__":
    print(train(Tracking(), Path("outputs/physics_only"))[1].metrics)
