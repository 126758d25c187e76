"""What benchmarks/recipes.py compares: sets of recipes, and suites of episodes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

from hno.evaluation.rollout import Disturbance

GRID5 = [(float(a), float(b)) for a, b in itertools.product(range(1, 6), repeat=2)]
GRID9 = [(a / 2, b / 2) for a, b in itertools.product(range(2, 11), repeat=2)]
BEYOND = [(1.0, 6.0), (3.0, 6.0), (5.0, 6.0), (5.5, 5.5), (6.0, 6.0)]


class Suite(NamedTuple):
    """Episodes that recipes are compared on."""

    types: Sequence[tuple[float, float]]
    """Player types."""
    starts: int
    """Safe starts per type."""
    widen: float = 1.0
    """Width of the start box in units of the game's."""
    split: str = "test"
    """Of the starts."""
    disturbance: Disturbance = Disturbance()
    """Of the controls."""


SUITES = {
    "validation": Suite(GRID5, 200, split="validation"),
    "integer types": Suite(GRID5, 200),
    "half types": Suite(GRID9, 20),
    "beyond": Suite(BEYOND, 60),
    "1.5 x box": Suite(GRID5, 40, widen=1.5),
    "2 x box": Suite(GRID5, 40, widen=2.0),
    "noise": Suite(GRID5, 40, disturbance=Disturbance(noise=0.2)),
    "delay": Suite(GRID5, 40, disturbance=Disturbance(delay=1)),
}
FEWER = {"drone": 0.3}
"""Share of the starts above that a game gets, because most of its starts collide inevitably."""
MOST = {"half types": 256, "beyond": 512, "1.5 x box": 256, "2 x box": 256}
"""Start states of a type after which the search for safe ones ends, where it is not 4096."""

CORNERS = "data.types=[[1,1],[1,5],[5,1],[5,5]]"
STEPS = "activation=tanh trainer.max_steps=1000 optimizer.lr=1e-2"
SHORT = f"operator=sno {STEPS}"
FIFTEEN = str([[a, b] for a, b in itertools.combinations_with_replacement(range(1, 6), 2)]).replace(" ", "")
TEN = f"{STEPS} {CORNERS} data.trajectories=10"
ANY = f"{STEPS} {CORNERS} operator=hno data.interior_types=box data.trajectories=200"
RECIPES: dict[str, dict[str, str]] = {
    "default": {
        "sno": "operator=sno activation=tanh",
        "sno, sin": "operator=sno activation=sin",
        "sno, 1e-2": "operator=sno activation=tanh optimizer.lr=1e-2",
        "hno": "operator=hno activation=tanh",
    },
    "hypothesis": {
        "sno": f"{STEPS} operator=sno",
        "hno": f"{STEPS} operator=hno",
        "sno, time of hno": f"{STEPS} trainer.max_steps=1250 operator=sno",
        "sno, corners": f"{STEPS} {CORNERS} operator=sno data.trajectories=200",
        "hno, corners": f"{STEPS} {CORNERS} operator=hno data.trajectories=200",
        "sno, corners, 50": f"{STEPS} {CORNERS} operator=sno data.trajectories=50",
        "hno, corners, 50": f"{STEPS} {CORNERS} operator=hno data.trajectories=50",
    },
    "activations": {
        f"{name} {rate:g}": f"{SHORT} activation={name} optimizer.lr={rate:g}"
        for name, rates in {
            "tanh": (1e-3, 3e-3, 1e-2, 3e-2),
            "relu": (3e-3, 1e-2, 3e-2),
            "sin activation.frequency=30": (3e-4, 1e-3, 3e-3),
            "sin activation.frequency=10": (1e-3, 3e-3, 1e-2),
            "sin activation.frequency=3": (3e-3, 1e-2, 3e-2),
        }.items()
        for rate in rates
    },
    "optimizers": {
        "soap 1e-2": SHORT,
        "soap 3e-3": f"{SHORT} optimizer.lr=3e-3",
        "soap 1e-2, polish": f"{SHORT} trainer.polish=100",
        "soap 1e-2, linear": f"{SHORT} optimizer.schedule=linear",
        "soap 1e-2, clip 1": f"{SHORT} trainer.gradient_clip_val=1.0",
        "adam 3e-3": f"{SHORT} optimizer=adam optimizer.lr=3e-3",
        "adam 1e-2": f"{SHORT} optimizer=adam optimizer.lr=1e-2",
        "adamw 1e-2": f"{SHORT} optimizer=adamw optimizer.lr=1e-2",
        "muon 2e-2": f"{SHORT} optimizer=muon optimizer.lr=2e-2",
    },
    "losses": {
        "huber": f"{SHORT} loss.norm=huber",
        "l2": f"{SHORT} loss.norm=l2",
        "free terminal value": f"{SHORT} operator.exact_terminal=false",
        "balance": f"{SHORT} loss.balance=true",
        "costate 3": f"{SHORT} loss.weights.costate=3",
        "physical units": f"{SHORT} loss.scaled=false",
        "batch 1024, twice the steps": f"{SHORT} data.batch_sizes.bvp=1024 trainer.max_steps=2000",
        "batch 4096, half the steps": f"{SHORT} data.batch_sizes.bvp=4096 trainer.max_steps=500",
    },
    "samplers": {
        "mixed": f"{SHORT} operator=hno",
        "uniform": f"{SHORT} operator=hno sampler=uniform",
        "band": f"{SHORT} operator=hno sampler=band",
        "labels": f"{SHORT} operator=hno sampler=labels",
        "rollout": f"{SHORT} operator=hno sampler=rollout",
        "hardest quarter": f"{SHORT} operator=hno loss.hardest=0.25",
    },
    "drone": {
        "tanh, 4000": "operator=sno activation=tanh trainer.max_steps=4000",
        "tanh, 8000": "operator=sno activation=tanh trainer.max_steps=8000",
        "tanh, 1e-2": "operator=sno activation=tanh optimizer.lr=1e-2",
        "tanh, 15 types": f"operator=sno activation=tanh data.trajectories=75 data.types={FIFTEEN}",
        "tanh, 4000, 400 labels a type": "operator=sno activation=tanh trainer.max_steps=4000 data.trajectories=400",
        "sin, 4000": "operator=sno activation=sin trainer.max_steps=4000",
    },
    "types": {
        "4 types x 280": f"{SHORT} {CORNERS} data.trajectories=280",
        "7 types x 160": SHORT,
        "15 types x 75": f"{SHORT} data.trajectories=75 data.types={FIFTEEN}",
    },
    "ten labels": {
        "sno": f"{TEN} operator=sno",
        "hno 0.02": f"{TEN} operator=hno",
        "hno 0.1": f"{TEN} operator=hno loss.weights.residual=0.1",
        "hno 0.1, around labels": f"{TEN} operator=hno loss.weights.residual=0.1 sampler=labels",
        "hno 0.002": f"{TEN} operator=hno loss.weights.residual=0.002",
    },
    "any type": {
        "0.1": f"{ANY} loss.weights.residual=0.1",
        "0.01": f"{ANY} loss.weights.residual=0.01",
        "0.1, around labels": f"{ANY} loss.weights.residual=0.1 sampler=labels",
        "0.1, rollouts": f"{ANY} loss.weights.residual=0.1 sampler=rollout",
        "0.1, whole horizon at once": f"{ANY} loss.weights.residual=0.1 data.widening=0",
    },
}
"""Overrides by name, by set."""
