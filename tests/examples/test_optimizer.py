from __future__ import annotations

import pytest
import torch
import yaml
from pytorch_optimizer import Lion

from hno.cli.arguments import parse
from hno.cli.config import compose, for_hydra
from hno.games import make
from hno.training.optimizers import make_optimizer
from tests.cli.conftest import SMOKE, Command
from tests.examples.conftest import FOLDER, Train

RECIPE = FOLDER / "recipe" / "conf"
pytestmark = pytest.mark.usefixtures("clean_globals")


def test_one_line_registers_it(installed: dict[str, dict[str, str]]):
    assert installed["hno.optimizers"] == {"lion": "pytorch_optimizer:Lion"}
    built = make_optimizer("lion", 10, lr=1e-3, betas=(0.8, 0.9))([torch.nn.Parameter(torch.ones(2))])
    assert isinstance(built["optimizer"], Lion)
    assert built["optimizer"].param_groups[0]["betas"] == (0.8, 0.9)


@pytest.mark.usefixtures("installed")
def test_yaml_chooses_it_by_its_name(train: Train):
    content = yaml.safe_load((RECIPE / "optimizer" / "lion.yaml").read_text())
    assert not any("." in str(value) for value in content.values() if isinstance(value, str))  # no import path
    config = compose("train", for_hydra("train", parse(["--config-dir", str(RECIPE), "optimizer=lion"])))
    chosen = {**config.optimizer, "lr": 3e-3}
    trained = train(make("tracking"), [(1, 1), (5, 5)], optimizer=chosen)
    assert trained.after < 0.5 * trained.before
    assert isinstance(trained.fitted.trainer.optimizers[0], Lion)


@pytest.mark.usefixtures("installed")
def test_the_command_line_needs_no_yaml(command: Command):
    run = command("train", *SMOKE, "optimizer=lion", "optimizer.betas=[0.8,0.9]", "trainer.max_steps=2")
    assert run.code == 0, run.text
    assert run.results["config"]["optimizer"]["name"] == "lion"
