"""What benchmarks/recipes.py compares: sets of recipes, and suites of episodes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

from hno.control.rollout import Disturbance

GRID5 = [(float(a), float(b)) for a, b in itertools.product(range(1, 6), repeat=2)]
GRID9 = [(a / 2, b / 2) for a, b in itertools.product(range(2, 11), repeat=2)]
TWELVE = [*itertools.product((1.0, 2.0, 4.0), repeat=2), (1.0, 5.0), (3.0, 3.0), (5.0, 2.0)]
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
    symmetric: bool = False
    """Whether all players start in the same own state."""
    ties: bool = False
    """Whether two equilibria of every start cost within 1 %."""
    box: tuple[list[list[float]], list[list[float]]] | None = None
    """Where starts are drawn, in place of the game's start box."""


SUITES = {
    "validation": Suite(GRID5, 200, split="validation"),
    "integer types": Suite(GRID5, 200),
    "half types": Suite(GRID9, 20),
    "beyond": Suite(BEYOND, 60),
    "1.5 x box": Suite(GRID5, 40, widen=1.5),
    "2 x box": Suite(GRID5, 40, widen=2.0),
    "noise": Suite(GRID5, 40, disturbance=Disturbance(noise=0.2)),
    "delay": Suite(GRID5, 40, disturbance=Disturbance(delay=1)),
    "noise and delay": Suite(GRID5, 40, disturbance=Disturbance(noise=0.2, delay=1)),
    "belief": Suite(GRID5, 40, disturbance=Disturbance(belief=0.5)),
    "3 x box": Suite(GRID5, 40, widen=3.0),
    "symmetric": Suite(GRID5, 12, symmetric=True),
    "ties": Suite(TWELVE, 25, ties=True),
    "head-on": Suite(GRID5, 40, box=([[22.5, 3.75, 0, 18]] * 2, [[27.5, 4.25, 0, 18]] * 2)),
}
FEWER = {"drone": 0.3}
"""Share of the starts above that a game gets, because most of its starts collide inevitably."""
MOST = {"half types": 256, "beyond": 512, "1.5 x box": 256, "2 x box": 256, "3 x box": 256, "symmetric": 256}
"""Start states of a type after which the search for safe ones ends, where it is not 4096."""

CORNERS = "data.types=[[1,1],[1,5],[5,1],[5,5]]"
TO_THE_END = "data.pretrain=0.4 data.widening=0.3 data.finish=0"
HNO = f"operator=hno {TO_THE_END}"
HARDENING = f"{HNO} loss.terms.residual=null loss.weights.residual=null ++loss.weights.annealed=0.02"
FINISHED = "operator=hno data.pretrain=0.2 data.widening=0.2 data.finish=0.4"
LATE = "operator=hno data.pretrain=0.4 data.widening=0.2 data.finish=0.2"
SEVEN = "data.types=null data.validation=16"
"""Types that labels are solved at, of the drone too."""
START_BOX = f"{SEVEN} data.trajectories=160 data.widen=[1.0] data.adaptive.rounds=0"
MIXED_BOXES = f"{SEVEN} data.trajectories=160 data.widen=[1.0,2.2] data.adaptive.rounds=0"
ADAPTIVE = f"{SEVEN} data.trajectories=96 data.widen=[1.0,2.2] data.adaptive.rounds=2 data.adaptive.labels=256"
"""About as many start states with labels as the two others have: 7 x 96 + 2 x 256 beside 7 x 160."""
EVERYWHERE = f"{ADAPTIVE} data.types=grid5 data.trajectories=27 data.validation=5"
"""The same number, at 25 types."""
VALUES = f"function=value {START_BOX}"
"""What every recipe is that does not choose what it learns."""
SHORT = "activation=tanh trainer.max_steps=1000"
FIFTEEN = str([[a, b] for a, b in itertools.combinations_with_replacement(range(1, 6), 2)]).replace(" ", "")
STEEP = f"{SHORT} optimizer.lr=1e-2"
TEN = f"{STEEP} {CORNERS} data.trajectories=10"
ANY = f"{HNO} {STEEP} {CORNERS} data.trajectories=200 data.interior_types=box"
RECIPES: dict[str, dict[str, str]] = {
    "potential": {
        f"{method}, {letter}, {where}": f"operator={method} {function} {labels}"
        for method in ("sno", "hno")
        for letter, function in (("V", "function=value"), ("W", "function=potential"))
        for where, labels in (
            ("start box", START_BOX),
            ("mixed boxes", MIXED_BOXES),
            ("adaptive", ADAPTIVE),
            ("adaptive, 25 types", EVERYWHERE),
        )
    },
    "default": {
        "sno, sin": "",
        "sno, tanh": "activation=tanh",
        "sno, tanh 1e-2": "activation=tanh optimizer.lr=1e-2",
        "hno, sin": HNO,
        "hno, tanh": f"{HNO} activation=tanh",
    },
    "hypothesis": {
        "sno": "",
        "hno": HNO,
        "sno, time of hno": "trainer.max_steps=2500",
        "sno, corners": f"{CORNERS} data.trajectories=200",
        "hno, corners": f"{HNO} {CORNERS} data.trajectories=200",
        "sno, corners, 50": f"{CORNERS} data.trajectories=50",
        "hno, corners, 50": f"{HNO} {CORNERS} data.trajectories=50",
        "hno, finish": FINISHED,
        "hno, corners, finish": f"{FINISHED} {CORNERS} data.trajectories=200",
        "hno, corners, 50, finish": f"{FINISHED} {CORNERS} data.trajectories=50",
    },
    "ten labels": {
        "sno": TEN,
        "hno 0.02": f"{TEN} {HNO}",
        "hno 0.1": f"{TEN} {HNO} loss.weights.residual=0.1",
        "hno 0.1, around labels": f"{TEN} {HNO} loss.weights.residual=0.1 sampler=labels",
        "hno 0.002": f"{TEN} {HNO} loss.weights.residual=0.002",
    },
    "activations": {
        f"{name} {rate:g}": f"activation={name} trainer.max_steps=1000 optimizer.lr={rate:g}"
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
        "soap 1e-2": STEEP,
        "soap 3e-3": SHORT,
        "soap 1e-2, polish": f"{STEEP} trainer.polish=100",
        "soap 1e-2, linear": f"{STEEP} optimizer.schedule=linear",
        "soap 1e-2, clip 1": f"{STEEP} trainer.gradient_clip_val=1.0",
        "adam 3e-3": f"{SHORT} optimizer=adam optimizer.lr=3e-3",
        "adam 1e-2": f"{SHORT} optimizer=adam optimizer.lr=1e-2",
        "adam 1e-3": f"{SHORT} optimizer=adam optimizer.lr=1e-3",
        "adam 3e-4": f"{SHORT} optimizer=adam optimizer.lr=3e-4",
        "adamw 1e-2": f"{SHORT} optimizer=adamw optimizer.lr=1e-2",
        "muon 6e-3": f"{SHORT} optimizer=muon optimizer.lr=6e-3",
        "muon 2e-2": f"{SHORT} optimizer=muon optimizer.lr=2e-2",
        "muon 6e-2": f"{SHORT} optimizer=muon optimizer.lr=6e-2",
    },
    "losses": {
        "l1": "",
        "huber": "loss.norm=huber",
        "costate 3": "loss.weights.costate=3",
        "batch 1024, twice the steps": "data.batch_sizes.bvp=1024 trainer.max_steps=4000",
        "width 128": "network.width=128",
    },
    "short losses": {
        "huber": f"{STEEP} loss.norm=huber",
        "l2": f"{STEEP} loss.norm=l2",
        "free terminal value": f"{STEEP} function.exact_terminal=false",
        "balance": f"{STEEP} loss.balance=true",
        "costate 3": f"{STEEP} loss.weights.costate=3",
        "physical units": f"{STEEP} loss.scaled=false",
        "batch 1024, twice the steps": f"{STEEP} data.batch_sizes.bvp=1024 trainer.max_steps=2000",
        "batch 4096, half the steps": f"{STEEP} data.batch_sizes.bvp=4096 trainer.max_steps=500",
    },
    "samplers": {
        "uniform": f"{HNO} sampler=uniform",
        "band": f"{HNO} sampler=band",
        "labels": f"{HNO} sampler=labels",
        "rollout": f"{HNO} sampler=rollout",
        "hardest quarter": f"{HNO} loss.hardest=0.25",
        "penalty rising from 5 %": f"{HARDENING} ++loss.terms.annealed.constant=penalty_height",
        "penalty steepening from 5 %": f"{HARDENING} ++loss.terms.annealed.constant=penalty_slope",
        "supervised finish": FINISHED,
        "band, supervised finish": f"{FINISHED} sampler=band",
        "supervised finish, 20 %": LATE,
        "supervised finish, 20 %, weight 0.1": f"{LATE} loss.weights.residual=0.1",
    },
    "drone": {
        "one net": "",
        "one net, 4000": "trainer.max_steps=4000",
        "one net, 4000, 400 labels a type": "trainer.max_steps=4000 data.trajectories=400",
        "one net, weight decay": "optimizer.weight_decay=0.1",
        "one net, tanh, 4000": "activation=tanh trainer.max_steps=4000",
        "one net, tanh, 8000": "activation=tanh trainer.max_steps=8000",
        "one net, tanh, 1e-2": "activation=tanh optimizer.lr=1e-2",
        "one net, tanh, 15 types": f"activation=tanh data.trajectories=75 data.types={FIFTEEN}",
        "one net, tanh, 4000, 400 labels a type": "activation=tanh trainer.max_steps=4000 data.trajectories=400",
        "median of 3": "function.members=3",
    },
    "types": {
        "4 types x 280": f"{CORNERS} data.trajectories=280",
        "7 types x 160": "",
        "15 types x 75": f"data.trajectories=75 data.types={FIFTEEN}",
    },
    "any type": {
        "sno": f"{STEEP} {CORNERS} data.trajectories=200",
        "0.1": f"{ANY} loss.weights.residual=0.1",
        "0.01": f"{ANY} loss.weights.residual=0.01",
        "0.1, around labels": f"{ANY} loss.weights.residual=0.1 sampler=labels",
        "0.1, rollouts": f"{ANY} loss.weights.residual=0.1 sampler=rollout",
        "0.1, whole horizon at once": f"{ANY} loss.weights.residual=0.1 data.widening=0",
    },
}
"""Overrides of the default recipe by name, by set; one net each, unless they say otherwise."""
