from __future__ import annotations

import pytest
import torch
from hno_examples.loss_term import GrowingResidual
from omegaconf import OmegaConf

import hno
from hno.cli.arguments import parse
from hno.cli.config import compose, for_hydra
from hno.games import make
from hno.losses import View, make_objective
from hno.operators import make_operator
from hno.types import Points, Sample
from tests.cli.conftest import SMOKE, Command
from tests.examples.conftest import FOLDER, Train

RECIPE = ("--config-dir", str(FOLDER / "recipe" / "conf"), "operator=growing")
pytestmark = pytest.mark.usefixtures("installed", "clean_globals")


def view(step: int) -> View:
    torch.manual_seed(0)
    game = make("tracking")
    operator = make_operator(game)
    x, theta = (box.sample(4, torch.Generator().manual_seed(0)) for box in (game.state_box, game.type_box))
    points = Points(torch.linspace(0, 3, 4), x, theta)
    return operator.view(Sample(points), operator.field(points), step=step)


@pytest.mark.parametrize(("step", "share"), [(0, 0.1), (4, 0.5), (9, 1.0), (1000, 1.0)])
def test_it_grows_in(step: int, share: float):
    full = GrowingResidual(steps=1).residual(view(0))
    torch.testing.assert_close(GrowingResidual(steps=10).residual(view(step)), share * full)


def test_the_recipe_is_a_method_by_yaml_alone(train: Train):
    config = compose("train", for_hydra("train", parse([*RECIPE, "loss.terms.growing_residual.steps=30"])))
    terms, weights = (OmegaConf.to_object(config.loss[name]) for name in ("terms", "weights"))
    assert make_objective(terms, weights).terms["growing_residual"].steps == 30
    trained = train(make("tracking"), [(1, 1), (5, 5)], terms=terms, weights=weights)
    assert trained.after < 0.5 * trained.before
    assert trained.fitted.metrics["loss/growing_residual"] > 0


def test_the_command_line_trains_with_the_recipe(command: Command):
    run = command("train", *RECIPE, *SMOKE, "data.pretrain=0", "data.finish=0", "trainer.max_steps=4")
    assert run.code == 0, run.text
    assert hno.load_policy(run.folder / "last.ckpt").provenance.method == "growing"
    assert "loss/growing_residual" in run.results["metrics"]
    refused = command("train", *RECIPE, *SMOKE, "loss.terms.growing_residual.step=3")
    assert refused.code != 0
    assert "steps" in refused.text
